# Your own files: make raw WHITE=white.nef DARK=dark.nef BANDS="450nm=b450.nef 540nm=b540.nef" CAPTURES="a.nef b.nef"
# With CAMERA=camera.toml captures without colour become pictures finer than the lenslets.
# Without BANDS the captures become one-value-a-lenslet pictures; with BANDS they become spectra.
RUN ?= runs/raw
DARK ?=
BANDS ?=
CAPTURES ?=
CAMERA ?=
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

RESULT := $(if $(BANDS),spectra,pictures)

all: $(RUN)/SHA256SUMS
$(RUN)/SHA256SUMS: $(RUN)/calibration.h5 $(if $(CAPTURES),$(RUN)/$(RESULT)/.done)
.PHONY: all

BAND_FILES := $(foreach b,$(BANDS),$(word 2,$(subst =, ,$b)))
$(RUN)/calibration.h5: $(WHITE) $(DARK) $(BAND_FILES) | $(RUN)
	$(if $(WHITE),,$(error say which file shows the white target: WHITE=...))
	$(P) calibrate $(WHITE:%=--white %) $(DARK:%=--dark %) $(BANDS:%=--band %) -o $@ --overwrite

$(RUN)/spectra/.done: $(CAPTURES) $(RUN)/calibration.h5 | $(RUN)/spectra/
	$(P) demux $(CAPTURES) --calibration $(RUN)/calibration.h5 --reference $(firstword $(WHITE)) -o $(RUN)/spectra --overwrite
	@touch $@

$(RUN)/pif.h5: $(CAMERA) | $(RUN)
	$(P) simulate-pif $(CAMERA) --superpixels 3x3 --coherent-ring 1 --model fresnel --accuracy 1e-2 -o $@ --overwrite

$(RUN)/pictures/.done: $(CAPTURES) $(RUN)/calibration.h5 $(if $(CAMERA),$(RUN)/pif.h5) | $(RUN)/pictures/
	$(P) reconstruct $(CAPTURES) $(if $(CAMERA),--method weighted --hold-out 0.1 --pif $(RUN)/pif.h5,--method block-mean) --calibration $(RUN)/calibration.h5 -o $(RUN)/pictures --overwrite
	@touch $@
