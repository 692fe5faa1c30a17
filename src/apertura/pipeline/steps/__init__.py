"""One module per wing, one function per rule: open → physics → stamp → save."""
