"""The command line of the rig: one module per command or group of commands.

`app` puts the commands together; `options` has what several of them share. Modules are light until
a command runs: heavy imports stand inside functions, so that ``rigd --help`` is quick.
"""
