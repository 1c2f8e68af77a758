# Both experiments at a small size and one page with their pictures.
RUN ?= runs/demo
include $(dir $(lastword $(MAKEFILE_LIST)))common.mk
HERE := $(dir $(lastword $(MAKEFILE_LIST)))
SUB = +$(MAKE) --no-print-directory -f

all: $(RUN)/SHA256SUMS
$(RUN)/SHA256SUMS: $(RUN)/report.html
.PHONY: all spatial spectral

spatial:
	$(SUB) $(HERE)spatial.mk RUN=$(RUN)/spatial CONFIG=sample_configs/demo_spatial.toml EXPERIMENTS="paper stray" ITERATIONS=6

spectral:
	$(SUB) $(HERE)spectral.mk RUN=$(RUN)/spectral CONFIG=sample_configs/demo_spectral.toml METHODS="pinv single-pixel"

$(RUN)/report.html: spatial spectral
	@if [ ! -e $@ ] || [ $(RUN)/spatial/report.html -nt $@ ] || [ $(RUN)/spectral/report.html -nt $@ ]; then \
	  echo "$(P) report $(RUN) -o $@ --view $(RUN)/view.html --overwrite"; $(P) report $(RUN) -o $@ --view $(RUN)/view.html --overwrite; fi
