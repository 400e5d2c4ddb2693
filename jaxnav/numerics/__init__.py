"""Divergences and linear and recurrent products, with their gradients."""
