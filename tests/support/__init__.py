"""What several tests share: small worlds, scenes, commands and independent references."""
