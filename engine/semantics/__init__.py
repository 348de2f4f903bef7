"""Label consistency between views: consistency-enhanced masks, the point cloud, pseudo labels; and free space."""
