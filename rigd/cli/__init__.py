"""The command line of the rig: one module per command or group of commands.

`app` assembles the commands; `options` has the options of several commands. Slow imports are inside
functions, so that ``rigd --help`` is quick.
"""
