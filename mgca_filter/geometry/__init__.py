"""Two-view geometry in numpy: epipolar distances, cameras, homographies, refinement of a pose. Knows no models."""
