"""A radar that stands still: channels, clocks and links are measured (`measurement`) and reported (`report`)."""
