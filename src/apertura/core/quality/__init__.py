"""Quality of an image: point targets, measures, numerical error."""
