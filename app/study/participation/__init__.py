"""Whether a participant takes part: active, completed, withdrawn."""
