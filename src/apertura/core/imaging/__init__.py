"""Image formation: range profiles, options, tiles, certificate, radiometry and quality checks of an image."""
