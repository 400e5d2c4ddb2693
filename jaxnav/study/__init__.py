"""The study of the paper's claims, which nothing else imports."""
