"""A campaign folder on disk: its configuration, its files, and the stages that are stored in it.

`config` is the schema of config.yaml, flights.tsv, segments.tsv and clocks.tsv; `folder.Campaign` knows where
everything lies; `store` writes and reads stages with their manifests; `digests` hashes files. Imports the layers below;
knows no rule of the workflow and computes no pixel.
"""
