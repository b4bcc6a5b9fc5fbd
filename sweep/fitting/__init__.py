"""The scene of a user's camera, estimated from photographs of known markers."""
