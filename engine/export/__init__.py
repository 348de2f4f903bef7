"""A finished lift in the forms that other programs read: COCO panoptic, label images, ScanNet's label files, points,
boxes, meshes."""
