"""Fixed episode lists, epsilon x seed sweeps, statistics, figures and the report."""
