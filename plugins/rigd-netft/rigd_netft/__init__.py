"""ATI Net F/T box as force-torque sensor of rigd, by its protocol RDT (on UDP).

`kind` declares the device, `protocol` has requests, records and status words, `pages` reads and
sets the box's web page, `sensor` is the driver, `box` a simulated box.
"""
