"""The claims of the source paper, each computed."""
