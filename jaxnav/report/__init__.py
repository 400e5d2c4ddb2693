"""The report of a run: one page with tables, charts and replays."""
