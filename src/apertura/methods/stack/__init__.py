"""Stack: residual motion between flights over one scene, and the coherence expected between their images."""
