"""A recorded run as files of other programs, or live in one of them; scenarios as FMUs."""
