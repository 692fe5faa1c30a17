"""Backprojection of range profiles to an image on the campaign grid."""
