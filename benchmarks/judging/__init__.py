"""Campaigns carried through the pipeline in this process, and what became of the targets that truth.json puts there."""
