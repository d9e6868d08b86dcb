"""A line with physics and the devices on it, told the time: what cannot be tried on real drives is tried here."""
