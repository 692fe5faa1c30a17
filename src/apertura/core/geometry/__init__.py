"""Where things are on Earth, and what a pair of antennas sees from there."""
