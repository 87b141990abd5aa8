"""ATI Net F/T box as force-torque sensor of rigd, by RDT over UDP.

`kind` declares the device, `protocol` has requests, records and status words, `pages` the box's web
page, `sensor` the driver, `box` a simulated box.
"""
