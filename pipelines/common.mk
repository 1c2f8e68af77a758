# Shared by all pipelines: one rule a stage, real prerequisites, nothing half-built.
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := all

P := plenocli
RUN ?= runs/experiment

$(RUN):
	@mkdir -p $@
$(RUN)/%/:
	@mkdir -p $@
