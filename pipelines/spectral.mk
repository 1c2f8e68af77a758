# Spectral calibration and demultiplexing, section 3-1 of the paper.
# make -f pipelines/spectral.mk RUN=runs/mine CONFIG=camera.toml BANDS="450nm 540nm 570nm 650nm"
# Every capture is a DNG, so that the same rules serve a real camera's files.
CONFIG ?= sample_configs/seed_spectral.toml
BANDS ?= 450nm 540nm 570nm 650nm
LONG ?= 10ms
SHORT ?= 2.5ms
METHODS ?= pinv single-pixel
SUPERPIXELS ?= 3x3

include $(dir $(lastword $(MAKEFILE_LIST)))common.mk

RAW := $(RUN)/raw
EXPOSURES := long short
SIM = $(P) capture-sim $(CONFIG) --pif $(RUN)/pif.h5 --overwrite
# named one by one, so that make keeps them and makes them again when they are missing
SPECTRA := $(foreach m,$(METHODS),$(foreach e,$(EXPOSURES),$(RUN)/spectra/chart-$e-$m.h5 $(RUN)/spectra/white-$e-$m.h5))

all: $(RUN)/report.html
.PHONY: all

# every wavelength that white light brings, once for all captures
$(RUN)/pif.h5: $(CONFIG) | $(RUN)
	$(P) simulate-pif $< --model fresnel --spectral-step auto --superpixels $(SUPERPIXELS) --accuracy 1e-3 -o $@ --overwrite

$(RAW)/white.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target white --exposure $(LONG) --seed 1 -o $@
$(RAW)/dark.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target dark --exposure $(LONG) --seed 2 -o $@
$(RAW)/band-%.dng: $(CONFIG) | $(RAW)/
	$(P) capture-sim $(CONFIG) --model fresnel --accuracy 1e-3 --target mono:$* --superpixels $(SUPERPIXELS) --exposure $(LONG) --seed 3 -o $@ --overwrite
$(RAW)/chart-long.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target colorchecker --exposure $(LONG) --seed 4 -o $@
$(RAW)/chart-short.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target colorchecker --exposure $(SHORT) --seed 5 -o $@
# another white object at each exposure, for the SNR: over its lenslets, the reference divided out
$(RAW)/white-long.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target white --exposure $(LONG) --seed 6 -o $@
$(RAW)/white-short.dng: $(RUN)/pif.h5 | $(RAW)/
	$(SIM) --target white --exposure $(SHORT) --seed 7 -o $@

BAND_FILES := $(BANDS:%=$(RAW)/band-%.dng)
$(RUN)/calibration.h5: $(RAW)/white.dng $(RAW)/dark.dng $(BAND_FILES)
	$(P) calibrate --white $(RAW)/white.dng --dark $(RAW)/dark.dng $(foreach b,$(BANDS),--band $b=$(RAW)/band-$b.dng) -o $@ --overwrite

define DEMUX
$(RUN)/spectra/%-$(1).h5: $(RAW)/%.dng $(RAW)/white.dng $(RUN)/calibration.h5 | $(RUN)/spectra/
	$(P) demux $$< --calibration $(RUN)/calibration.h5 --method $(1) --reference $(RAW)/white.dng -o $$@ --overwrite
$(RUN)/score-%-$(1).json: $(RUN)/spectra/chart-%-$(1).h5 $(RUN)/spectra/white-%-$(1).h5
	$(P) score $$< --truth colorchecker --patches colorchecker --white $(RUN)/spectra/white-$$*-$(1).h5 -o $$@ --overwrite
endef
$(foreach m,$(METHODS),$(eval $(call DEMUX,$m)))

# the paper's figure of a spectral image opens in any OpenEXR viewer
$(RUN)/chart.exr: $(RAW)/chart-long.dng $(RUN)/calibration.h5
	$(P) demux $< --calibration $(RUN)/calibration.h5 --method pinv --reference $(RAW)/white.dng -o $@ --overwrite

SCORES := $(foreach m,$(METHODS),$(foreach e,$(EXPOSURES),$(RUN)/score-$e-$m.json))
$(RUN)/report.html: $(SCORES) $(SPECTRA) $(RUN)/chart.exr
	$(P) report $(RUN) -o $@ --overwrite
