"""What several rooms ask of the operating system in the same way."""
