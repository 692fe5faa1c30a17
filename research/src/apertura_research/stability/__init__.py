"""Every impairment against every correction."""
