"""Verification of products: provenance chain to the raw samples, comparison of two products, reproduction."""
