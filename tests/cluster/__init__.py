"""A campaign on a real batch system, disturbed: a program, not part of the test suite."""
