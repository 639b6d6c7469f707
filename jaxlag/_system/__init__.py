"""The system, and its quantities at one state."""
