# Your own files: make raw WHITE=white.nef DARK=dark.nef BANDS="450nm=b450.nef 540nm=b540.nef" CAPTURES="a.nef b.nef"
# Without BANDS the captures become one-value-a-lenslet pictures; with BANDS they become spectra.
RUN ?= runs/raw
DARK ?=
BANDS ?=
CAPTURES ?=
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

RESULT := $(if $(BANDS),spectra,pictures)

all: $(RUN)/calibration.h5 $(if $(CAPTURES),$(RUN)/$(RESULT)/.done)
.PHONY: all

BAND_FILES := $(foreach b,$(BANDS),$(word 2,$(subst =, ,$b)))
$(RUN)/calibration.h5: $(WHITE) $(DARK) $(BAND_FILES) | $(RUN)
	$(if $(WHITE),,$(error say which file shows the white target: WHITE=...))
	$(P) calibrate $(WHITE:%=--white %) $(DARK:%=--dark %) $(BANDS:%=--band %) -o $@ --overwrite

$(RUN)/spectra/.done: $(CAPTURES) $(RUN)/calibration.h5 | $(RUN)/spectra/
	$(P) demux $(CAPTURES) --calibration $(RUN)/calibration.h5 --reference $(firstword $(WHITE)) -o $(RUN)/spectra --overwrite
	@touch $@

$(RUN)/pictures/.done: $(CAPTURES) $(RUN)/calibration.h5 | $(RUN)/pictures/
	$(P) reconstruct $(CAPTURES) --method block-mean --calibration $(RUN)/calibration.h5 -o $(RUN)/pictures --overwrite
	@touch $@
