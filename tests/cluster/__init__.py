"""A campaign on a real batch system with disturbances: a program, not part of the test suite."""
