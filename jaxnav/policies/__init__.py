"""The three causal pathways, the ten methods and the recurrent decision."""
