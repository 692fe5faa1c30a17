"""Processing of campaigns within this process, and evaluation of the targets listed in truth.json."""
