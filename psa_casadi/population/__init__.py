"""Many devices: what is common to them, what differs beyond noise, and which do not belong."""
