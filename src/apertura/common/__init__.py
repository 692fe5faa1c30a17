"""Basis of all layers: errors, flags, documents, confined paths, atomic writes, constants, contracts, provenance.

The package provides small types and functions without radar or campaign logic. The package imports no other layer and
computes no pixels. All access to a campaign folder uses `confined`. `contracts` defines the content of each stage;
`code_imports` and `provenance` record the code and inputs of a result.
"""
