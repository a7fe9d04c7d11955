"""Files and messages: everything that gets samples into the core and results out of it."""
