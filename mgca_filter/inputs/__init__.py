"""What the caller holds: keypoints, matches, attributes, options; read, checked and normalised."""
