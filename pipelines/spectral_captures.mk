# Included by spectral.mk and colorchecker.mk: the system matrix of white light, and the captures that calibrate CONFIG or are a white object.
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

RAW := $(RUN)/raw
EXPOSURES := long short
SIM = $(P) capture-sim $(CONFIG) --pif $(RUN)/pif.h5 --overwrite
BAND_FILES := $(BANDS:%=$(RAW)/band-%.dng)

# every wavelength that white light brings, once for all captures
$(RUN)/pif.h5: $(CONFIG) | $(RUN)
	$(P) simulate-pif $< --model fresnel --spectral-step auto --superpixels $(SUPERPIXELS) --accuracy 1e-3 -o $@ --overwrite

$(RAW)/white.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target white --exposure $(LONG) --seed 1 -o $@
$(RAW)/dark.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target dark --exposure $(LONG) --seed 2 -o $@
$(RAW)/band-%.dng: $(CONFIG) | $(RAW)/
	$(P) capture-sim $(CONFIG) --model fresnel --accuracy 1e-3 --target mono:$* --superpixels $(SUPERPIXELS) --exposure $(LONG) --seed 3 -o $@ --overwrite
# another white object at each exposure, for the SNR: over its lenslets, the reference divided out
$(RAW)/white-long.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target white --exposure $(LONG) --seed 6 -o $@
$(RAW)/white-short.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target white --exposure $(SHORT) --seed 7 -o $@
