"""Echo processing: captures to transfer functions and range profiles, sidelink correction, calibration."""
