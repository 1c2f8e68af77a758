# A real ColorChecker, photographed under narrow-band light: measured against a spectrometer, then seen by a plenoptic camera.
# make -f pipelines/colorchecker.mk RUN=runs/mine DATA=captures CFA=GBRG CONFIG=camera.toml BANDS="450nm 540nm 570nm 650nm"
# DATA: a folder with captures such as chart_550nm_25ms.tif, dark frames, a label map and spectra.csv (plenocli colorchecker --help).
CONFIG ?= sample_configs/seed_spectral.toml
BANDS ?= 450nm 540nm 570nm 650nm
CFA ?= GBRG
LONG ?= 10ms
SHORT ?= 625us
METHODS ?= pinv wls lmmse single-pixel
SUPERPIXELS ?= 3x3
ifndef DATA
$(error say where the captures are: DATA=folder)
endif

include $(dir $(lastword $(MAKEFILE_LIST)))spectral_captures.mk

SCORES := $(EXPOSURES:%=$(RUN)/score-%.json)

all: $(RUN)/SHA256SUMS
$(RUN)/SHA256SUMS: $(RUN)/report.html
.PHONY: all

# the real chart: numbers against the spectrometer, and an upright scene
$(RUN)/chart.h5 $(RUN)/chart.json &: $(shell find $(DATA) -type f) | $(RUN)
	$(P) colorchecker $(DATA) --cfa $(CFA) --measures $(RUN)/chart.json -o $(RUN)/chart.h5 --overwrite

$(RAW)/chart-long.dng: $(RUN)/pif.h5 $(RUN)/chart.h5 | $(RAW)/
	$(SIM) --scene $(RUN)/chart.h5 --exposure $(LONG) --seed 4 -o $@
$(RAW)/chart-short.dng: $(RUN)/pif.h5 $(RUN)/chart.h5 | $(RAW)/
	$(SIM) --scene $(RUN)/chart.h5 --exposure $(SHORT) --seed 5 -o $@

$(RUN)/calibration.h5: $(RAW)/white.dng $(RAW)/dark.dng $(BAND_FILES)
	$(P) calibrate --white $(RAW)/white.dng --dark $(RAW)/dark.dng $(foreach b,$(BANDS),--band $b=$(RAW)/band-$b.dng) -o $@ --overwrite

define DEMUX
$(RUN)/spectra/%-$(1).h5: $(RAW)/%.dng $(RAW)/white.dng $(RUN)/calibration.h5 | $(RUN)/spectra/
	$(P) demux $$< --calibration $(RUN)/calibration.h5 --method $(1) --reference $(RAW)/white.dng -o $$@ --overwrite
endef
$(foreach m,$(METHODS),$(eval $(call DEMUX,$m)))

# all methods of an exposure side by side, against the scene as the filters see it
define SCORE
$(RUN)/score-$(1).json: $(foreach m,$(METHODS),$(RUN)/spectra/chart-$(1)-$m.h5 $(RUN)/spectra/white-$(1)-$m.h5) $(RUN)/chart.h5 $(CONFIG)
	$(P) score $(foreach m,$(METHODS),$(RUN)/spectra/chart-$(1)-$m.h5) $(foreach m,$(METHODS),--white $(RUN)/spectra/white-$(1)-$m.h5) \
		--truth $(RUN)/chart.h5 --camera $(CONFIG) --patches colorchecker -o $$@ --overwrite
endef
$(foreach e,$(EXPOSURES),$(eval $(call SCORE,$e)))

$(RUN)/report.html: $(SCORES) $(RUN)/chart.json
	$(P) report $(RUN) -o $@ --overwrite
