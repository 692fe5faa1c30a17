"""Planning of image formation: choice of engine and models, with reasons and cost."""
