"""Products compared with what they claim to be made from: their chain to the raw samples, made again, with others."""
