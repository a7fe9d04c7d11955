"""G2: a lever arm and a delay of seconds, found by comparing every reference sample at a row of delays."""
