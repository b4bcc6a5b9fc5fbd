"""From scenes to estimates: rendered, detected, estimated, for N cells of a grid."""
