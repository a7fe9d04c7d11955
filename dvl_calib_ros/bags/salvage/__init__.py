"""Reading on where a recording is damaged."""
