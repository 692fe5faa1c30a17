"""Effect of every impairment under every correction."""
