"""Export a finished lift in other programs' formats: COCO panoptic, label images, ScanNet's label files, points, boxes,
meshes."""
