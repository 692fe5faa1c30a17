"""Clock of a recorder against its flight log, from echoes: on a bright point, or on the sharpness of the ground."""
