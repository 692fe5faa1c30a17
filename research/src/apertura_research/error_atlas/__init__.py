"""Image errors from negligible to destructive size: measured and expected loss, and the flags raised."""
