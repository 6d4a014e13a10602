"""From weights to the model file that every runtime reads."""
