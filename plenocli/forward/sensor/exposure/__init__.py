"""One exposure: what a sensor reports of a scene.

Light goes through system matrices to the sensor (`carried_light`), which records it (`recorder`),
band of lenslets by band where a sensor is large (`simulate`).
"""
