# Shared by all pipelines: one rule a stage, real prerequisites, nothing half-built.
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := all

P := plenocli
RUN ?= runs/experiment
include $(dir $(lastword $(MAKEFILE_LIST)))names.mk

$(RUN):
	@mkdir -p $@
$(RUN)/%/:
	@mkdir -p $@
# else Make takes them for files of its own and tries to remove them at the end
.PRECIOUS: $(RUN)/%/
