"""What is in front of the camera: animated scenes as plain data."""
