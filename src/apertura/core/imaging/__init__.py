"""One image: its range profiles, its plan, its tiles and its certificate."""
