"""The search for effects: candidates, selection, elimination, identifiability."""
