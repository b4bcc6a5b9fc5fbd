"""Why measured poses are wrong: causes by posterior odds; and one detection's covariance."""
