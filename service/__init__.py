"""The daemon: aligns readings in time, keeps the maps, stores and publishes them; and the command line around it."""
