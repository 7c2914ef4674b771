"""Random things for interiors. Metres, y up, fronts towards +z."""
