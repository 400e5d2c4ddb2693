"""The study of the paper's claims; nothing outside it depends on it."""
