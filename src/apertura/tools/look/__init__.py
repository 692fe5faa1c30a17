"""A look at a campaign while it flies: images of the pulses so far, beside the results; no stage is written."""
