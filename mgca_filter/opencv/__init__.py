"""OpenCV's own names, argument orders and return types over the filter."""
