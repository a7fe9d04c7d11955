"""Messages about data, configurations and results: tables of codes with sentence, meaning and remedy."""
