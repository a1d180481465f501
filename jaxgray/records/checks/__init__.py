"""What can be said of a record before any model: defects of channels, and of channels beside one another."""
