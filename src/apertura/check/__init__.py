"""What can be told of a campaign folder before anything runs."""
