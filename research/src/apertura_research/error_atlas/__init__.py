"""What spoils an image, from negligible to destructive: what it costs, what was expected, which flags came."""
