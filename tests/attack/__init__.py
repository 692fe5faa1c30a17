"""What strangers and faults do to a campaign, as programs: each can be run for minutes in the tests and for hours."""
