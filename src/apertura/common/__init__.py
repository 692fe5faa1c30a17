"""Basis of every layer: errors, flags, documents, confined paths, atomic writes, constants, contracts, provenance.

Offers small values and functions that know neither radar nor campaign. Imports nothing of the other layers and computes
no pixel; `confined` is the only door to a campaign folder; `contracts` states the content of a stage, `code_imports`
and `provenance` the code and inputs of a result.
"""
