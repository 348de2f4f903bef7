"""Which labels are consistent? Consistency-enhanced masks, the semantic point cloud, pseudo labels."""
