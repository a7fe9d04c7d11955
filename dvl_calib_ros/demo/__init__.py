"""Playing bags over DDS, and showing the node's answers, for the demo."""
