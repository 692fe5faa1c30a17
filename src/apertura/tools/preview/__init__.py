"""Live view of a campaign during the flight: images of the pulses recorded so far, next to the results."""
