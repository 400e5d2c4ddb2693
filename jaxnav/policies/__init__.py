"""The three causal pathways, the methods that make experience, and the recurrent decision."""
