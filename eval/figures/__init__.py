"""Pictures of scenes and clips."""
