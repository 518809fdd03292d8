"""What is to be done: costs, references, courses, starts."""
