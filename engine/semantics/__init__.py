"""Label consistency between views: consistency-enhanced masks, the semantic point cloud, and pseudo labels."""
