"""Pictures of scenes, clips and estimators, to look at and for the docs."""
