"""Pages of docs/ that are written from the code, and what a built site must hold."""
