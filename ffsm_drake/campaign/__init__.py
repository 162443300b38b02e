"""Campaigns: thousands of runs of dispersed scenarios, kept in one database, judged in one report.

spec -> sampling -> cases -> evaluate (in workers, by executor) -> store -> statistics -> report; ``run`` drives.
Nothing is imported here, so that the command line starts fast.
"""
