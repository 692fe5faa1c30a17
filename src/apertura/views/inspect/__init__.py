"""`apertura inspect`: kind and contents of a file or folder, and the data that are missing for image formation."""
