"""Planning of image formation: engine, models, their reasons and their cost."""
