"""Which masks are one object? Oriented boxes and Algorithm 1, the view agreement, votes on classes and labels."""
