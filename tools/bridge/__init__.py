"""Say where a vehicle is to other programs: autopilots by MAVLink, chart plotters by NMEA 0183, anyone by HTTP."""
