"""What is wrong with delivered data, found before any time is spent on it."""
