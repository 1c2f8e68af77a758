from plenocli.base.quantities import Section, Wavelength


class Light(Section):
    design: Wavelength = 550e-9
    span: tuple[Wavelength, Wavelength] | None = None


def test_a_field_s_default_stays_out_of_the_schema_of_others():
    schema = Light.model_json_schema()["properties"]
    assert schema["design"]["default"] == 550e-9
    for entry in schema["span"]["anyOf"][0]["prefixItems"]:
        assert entry["type"] == "string" and "default" not in entry
