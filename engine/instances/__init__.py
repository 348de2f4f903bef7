"""Groups 2D masks into 3D objects: oriented boxes and Algorithm 1, agreement of views, votes on classes and labels."""
