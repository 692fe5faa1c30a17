"""Changes between two images of one scene: amplitude ratio, loss of coherence, mask at a false-alarm rate, regions."""
