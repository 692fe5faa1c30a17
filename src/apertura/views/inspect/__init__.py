"""`apertura inspect`: kind and contents of a file or folder, and the data missing to form an image from it."""
