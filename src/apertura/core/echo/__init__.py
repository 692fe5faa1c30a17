"""From captured symbols to calibrated transfer functions and range profiles."""
