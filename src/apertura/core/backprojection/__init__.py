"""From range profiles to a focused image on the campaign grid."""
