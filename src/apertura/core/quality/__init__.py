"""Image quality: point targets, focus, agreement of images, error budget and numerical error."""
