"""Pages of docs/ that are generated from the code, and checks of the built site."""
