"""Campaign folder on disk: its config, its files, and its stored stages.

`config` is the schema of config.yaml, flights.tsv, segments.tsv and clocks.tsv; `folder.Campaign` returns the paths of
all files; `store` writes and reads stages with their manifests; `digests` hashes files. The package imports the
layers below; it is independent of the rules of the workflow, and does not compute pixels.
"""
