"""What every layer stands on: errors, flags, documents, paths, atomic writes, constants, contracts, provenance.

Offers small values and functions that know neither radar nor campaign. Imports nothing of the other layers and computes
no pixel; `contracts` says what a stage holds, `code_imports` and `provenance` say what it was made by.
"""
