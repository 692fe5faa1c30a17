"""A run as people watch it: what happened so far, how long it will take, what is there, and what may be removed."""
