"""Groups masks into objects: oriented boxes and Algorithm 1, the view agreement, votes on classes and labels."""
