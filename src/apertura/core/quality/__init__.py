"""How good an image is: point targets, measures, numerical error."""
