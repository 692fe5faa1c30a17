"""Campaign folders like real ones from a scene, trajectories and impairments with known truth."""
