"""A configuration is strict, and what is wrong with it is said in one line."""

import re
from pathlib import Path

import msgspec
import pytest
import yaml

from risaf_link.config import Config, dump, load, load_calibration
from risaf_link.errors import ConfigError
from risaf_link.links import RecordingParameters
from risaf_link.publish.access import PASSWORD, MqttParameters, address, broker_of

EXAMPLE = Path(__file__).parents[1] / "config" / "risaf_link.yaml"


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def leaves(tree: object, path: str = "") -> set[str]:
    if isinstance(tree, dict) and tree and path != "emit":
        return {
            leaf
            for key, value in tree.items()
            for leaf in leaves(value, f"{path}.{key}"[not path :])
        }
    return {path}


def test_the_example_holds_every_key_with_its_default():
    assert load(EXAMPLE) == Config()
    assert leaves(yaml.safe_load(EXAMPLE.read_text())) == leaves(msgspec.to_builtins(Config()))


def test_the_example_says_of_every_key_why():
    lines = [line for line in EXAMPLE.read_text().splitlines() if re.match(r" +\w+: ", line)]
    assert all("#" in line for line in lines if line.split(":")[0].strip() not in Config().emit)


def test_what_the_example_says_of_recordings_are_the_defaults():
    block = EXAMPLE.read_text().partition("#   recording:\n")[2].partition("\n\n")[0]
    lines = [line.partition("#     ")[2] for line in block.splitlines()]
    told = yaml.safe_load("\n".join(lines))
    assert told == msgspec.to_builtins(RecordingParameters())


def test_what_is_dumped_loads_again(tmp_path):
    config = load(None, ["fusion.method=mean", "links.1.url=tcpout://localhost:5760", "array.id=3"])
    assert load(written(tmp_path / "c.yaml", dump(config))) == config


def test_an_empty_file_means_the_defaults(tmp_path):
    assert load(written(tmp_path / "c.yaml", "# nothing\n")) == Config()


def test_every_key_can_be_set_from_the_command_line():
    for key in leaves(msgspec.to_builtins(Config())):
        value: object = msgspec.to_builtins(Config())
        for step in key.split("."):
            value = value[step]  # type: ignore[index]
        assert load(None, [f"{key}={yaml.safe_dump(value, default_flow_style=True)}"]) == Config()


def test_settings_go_over_the_file(tmp_path):
    path = written(tmp_path / "c.yaml", "fusion: {alpha: 0.9, method: mean}")
    fusion = load(path, ["fusion.alpha=0.5"]).fusion
    assert (fusion.alpha, fusion.method) == (0.5, "mean")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "fusion: {gaet: 1}",
            "fusion.gaet: unknown key; known: method, gyro_noise, bias_walk",
        ),
        ("fusion: {alpha: '0.9'}", "fusion.alpha: found '0.9', expected float"),
        ("fusion: {alpha: 1}", "fusion.alpha: found 1, expected float < 1.0"),
        ("fusion: {alpha: .nan}", "fusion.alpha: found nan, expected float >= 0.0"),
        ("fusion: {method: best}", "fusion.method: found 'best', expected one of "),
        ("fusion:", "fusion: found nothing, expected object"),
        ("heading: {source: [auto]}", "heading.source: found ['auto'], expected str"),
        ("array: {encodings: [GYRO]}", "array.encodings.0: found 'GYRO', expected one of "),
        ("array: {id: 256}", "array.id: found 256, expected int <= 255"),
        ("array: {sensors: 1.5}", "array.sensors: found 1.5, expected int"),
        (
            "emit: {ATTITUDE: 5}",
            "emit.ATTITUDE: unknown key; known: ARRAY_SENSOR_HEALTH",
        ),
        (
            "emit: {ATTITUDE_QUATERNION: 50, ARRAY_STATUS: 0}",
            "emit.ARRAY_STATUS: found 0, expected float > 0.0",
        ),
        ("links: [{url: 'udpin://:1'}]", "links.0.name: found nothing, expected a value"),
        (
            "links: [{name: a, url: x, speed: 1}]",
            "links.0.speed: unknown key; known: name, url, emit",
        ),
        ("links: [{name: a, url: 'udp://x:1'}]", "links.0.url: a: 'udp://x:1' found, one of "),
        (
            "links: [{name: a, url: 'udpin://x:1'}, {name: a, url: 'udpin://x:2'}]",
            "links.1.name: found 'a' twice, expected once",
        ),
        (
            "links: [{name: a, url: 'tlog:///a.tlog'}, {name: b, url: 'tlog:///a.tlog'}]",
            "links.1.url: found 'tlog:///a.tlog' beside the recording /a.tlog, expected names that "
            "no segment of another has",
        ),
        (
            "links: [{name: a, url: 'tlog:///a.12.tlog'}, {name: b, url: 'tlog:///b/../a.tlog'}]",
            "links.1.url: found 'tlog:///b/../a.tlog' beside the recording /a.12.tlog, ",
        ),
        (
            "links: [{name: a, url: 'udpin://x:1', recording: {}}]",
            "links.0.recording: found it of a link with peers, expected it of a recording",
        ),
        (
            "links: [{name: a, url: 'tlog:///a.tlog', recording: {segment_bytes: 10}}]",
            "links.0.recording.segment_bytes: found 10, expected int >= 1000000",
        ),
        (
            "links: [{name: a, url: 'tlog:///a.tlog', recording: {most: 1}}]",
            "links.0.recording.most: unknown key; known: segment_bytes, segment_s, most_bytes, ",
        ),
        (
            "fusion: {alpha: 0.9}\nfusion: {alpha: 0.8}",
            "line 2: fusion: found twice, expected once",
        ),
        ("mqtt: {url: 'tcp://x'}", "mqtt.url: found something else, expected mqtt://HOST:PORT or"),
        ("mqtt: {url: 'mqtt://x:0'}", "mqtt.url: found something else, expected "),
        ("mqtt: {vehicle: a/b}", "mqtt.vehicle: found 'a/b', expected str matching regex"),
        ("mqtt: {prefix: 'a/#'}", "mqtt.prefix: found 'a/#', expected str matching regex"),
        ("mqtt: {password: x}", "mqtt.password: unknown key; known: url, prefix, vehicle"),
        ("mqtt: {qos: {events: 0}}", "mqtt.qos.events: found 0, expected one of 1, 2"),
        ("mqtt: {rates: {events: 1}}", "mqtt.rates.events: unknown key; known: attitude"),
        (
            "mqtt: {url: 'mqtt://x', ca: ca.pem}",
            "mqtt.ca: found it with 'mqtt://x', expected mqtts://",
        ),
        (
            "mqtt: {url: 'mqtts://x', certificate: own.pem}",
            "mqtt.key: found nothing, expected a file beside the other",
        ),
        ("metrics: {listen: ':9100'}", "metrics.listen: found ':9100', expected ADDRESS:PORT"),
        ("- 1", "found [1], expected keys with values"),
        ("fusion: {", "while parsing a flow"),
        ("x: 2026-13-45", "line 1: found '2026-13-45', expected one of kind timestamp"),
        ("\nx: !!int ten", "line 2: found 'ten', expected one of kind int"),
        ("x: !!bool maybe", "line 1: found 'maybe', expected one of kind bool"),
        ("x: 0x_", "line 1: found '0x_', expected one of kind int"),
        (f"x: {'9' * 5000}", "found a value of more than 2048 characters"),
        ("x: !!map y", "expected a mapping node, but found scalar"),
        ("[" * 2000, "found values more than 32 deep"),
        ("{" * 2000, "found values more than 32 deep"),
        ('array: {calibration: "a\\0"}', "line 1: found characters that are not for text"),
        ('state: {file: "\\ud800"}', "line 1: found characters that are not for text"),
        ('? "a\\nb"\n: 1', r"a\nb: unknown key; known: array, gps"),
        ('? "a` - at `$.b.c"\n: 1', "a` - at `$.b.c: unknown key; known: array, gps"),
        ('links: [{"`": 1}]', "links.0.`: unknown key; known: name, url"),
        ('? "a - at b"\n: 1', "a - at b: unknown key; known: array, gps"),
        ('fusion: {method: "a - at `$.b"}', "fusion.method: found 'a - at `$.b', expected one of"),
        ('links: [{name: "a\\n\\e[2J", url: x}]', r"links.0.url: a\n\x1b[2J: 'x' found, one of"),
        ("a: b: c", "mapping values are not allowed here"),
    ],
)
def test_one_line_says_key_found_and_expected(tmp_path, text, message):
    path = written(tmp_path / "c.yaml", text)
    with pytest.raises(ConfigError) as caught:
        load(path)
    line = str(caught.value)
    assert message in line
    assert line.startswith(f"{path}: ")
    assert line.isprintable()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("fusion.alpha", "--set fusion.alpha: expected KEY=VALUE"),
        ("fusion.gaet=1", "fusion.gaet: unknown key"),
        ("links.7.url=udpin://a:1", "--set links.7.url: no such key"),
        ("fusion.alpha.x=1", "--set fusion.alpha.x: no such key"),
        ("fusion.alpha={", "--set fusion.alpha: found '{', expected a YAML value"),
        (
            "fusion.alpha=2026-13-45",
            "--set fusion.alpha: found '2026-13-45', expected a YAML value",
        ),
        ("a\nb", r"--set a\nb: expected KEY=VALUE"),
    ],
)
def test_a_wrong_setting_is_named(setting, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        load(None, [setting])


def test_recordings_of_different_names_may_lie_beside_each_other():
    for other in ("/b.tlog", "/a.b.tlog", "/a.1.2.tlog", "/a.01.tlog", "/c/a.1.tlog"):
        links = f"links=[{{name: a, url: 'tlog:///a.tlog'}}, {{name: b, url: 'tlog://{other}'}}]"
        assert len(load(None, [links]).links) == 2


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.yaml: No such file"):
        load(tmp_path / "none.yaml")


class TestCalibrationFile:
    def load(self, tmp_path, text, *settings):
        path = written(tmp_path / "calibration.yaml", text)
        return load_calibration(load(None, [f"array.calibration={path}", *settings]))

    def test_no_file_no_calibration(self):
        assert load_calibration(Config()) is None

    def test_what_is_left_out_is_perfect(self, tmp_path):
        calibration = self.load(tmp_path, "gyros: [{bias: [0.1, 0, 0]}, {}]")
        assert [triad.bias for triad in calibration.gyros] == [[0.1, 0, 0], [0, 0, 0]]
        assert calibration.gyros[1].scale == [1, 1, 1]

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("gyros: []", "gyros: found [], expected array of length >= 1"),
            (
                "gyros: [{bias: [1, 2]}]",
                "gyros.0.bias: found [1, 2], expected array of length >= 3",
            ),
            ("gyros: [{}, {skale: 1}]", "gyros.1.skale: unknown key; known: bias, scale, "),
            (
                "gyros: [{mounting: [0, 0, 0, 0]}]",
                "gyros[0].mounting: found [0.0, 0.0, 0.0, 0.0], exp",
            ),
            ("", "found nothing, expected object"),
        ],
    )
    def test_what_is_wrong_is_named(self, tmp_path, text, message):
        with pytest.raises(ConfigError, match=re.escape(message)):
            self.load(tmp_path, text)

    def test_it_must_be_for_as_many_sensors_as_configured(self, tmp_path):
        with pytest.raises(ConfigError, match=r"array\.sensors: found 3, expected 1"):
            self.load(tmp_path, "gyros: [{}]", "array.sensors=3")


class TestMqttSecrets:
    """No password is printed, whatever is wrong with it."""

    def chosen(self, **keys):
        return MqttParameters(url="mqtts://broker.example", user="rover", vehicle="v", **keys)

    def test_a_password_in_the_url_is_refused_and_not_repeated(self, tmp_path):
        path = written(tmp_path / "c.yaml", "mqtt: {url: 'mqtt://rover:hunter2@broker:1883'}")
        with pytest.raises(ConfigError, match="in keys of their own") as caught:
            load(path)
        assert "hunter2" not in str(caught.value)

    def test_the_environment_or_the_file_says_it_and_nothing_shows_it(self, tmp_path, monkeypatch):
        monkeypatch.setenv(PASSWORD, "hunter2")
        from_environment = broker_of(self.chosen())
        secret = tmp_path / "secret"
        secret.touch(0o600)
        secret.write_text("hunter3\n")
        from_file = broker_of(self.chosen(password_file=str(secret)))
        assert (from_environment.password, from_file.password) == ("hunter2", "hunter3")
        config = msgspec.structs.replace(Config(), mqtt=self.chosen(password_file=str(secret)))
        for text in (repr(from_environment), repr(from_file), dump(config)):
            assert "hunter" not in text

    def test_a_file_that_others_may_read_is_refused(self, tmp_path):
        secret = written(tmp_path / "secret", "hunter2")
        secret.chmod(0o640)
        with pytest.raises(ConfigError, match=r"mqtt\.password_file: .* mode 0640") as caught:
            broker_of(self.chosen(password_file=str(secret)))
        assert "hunter2" not in str(caught.value)

    @pytest.mark.parametrize(
        ("keys", "message"),
        [
            ({"password_file": "none"}, "mqtt.password_file: none: found no file"),
            ({"ca": "none.pem"}, "mqtt.ca: none.pem: No such file or directory, expected PEM"),
            (
                {"certificate": "none.pem", "key": "none.key"},
                "mqtt.certificate: none.pem with none.key: No such file or directory, expected",
            ),
        ],
    )
    def test_a_file_that_is_not_there_is_named(self, keys, message):
        with pytest.raises(ConfigError, match=re.escape(message)):
            broker_of(self.chosen(**keys))

    @pytest.mark.parametrize(
        ("url", "expected"),
        [
            ("mqtt://broker", (False, "broker", 1883)),
            ("mqtts://broker.example/", (True, "broker.example", 8883)),
            ("mqtt://10.0.0.1:2000", (False, "10.0.0.1", 2000)),
            ("mqtts://[fe80::1]:99", (True, "fe80::1", 99)),
            ("mqtt://a:70000", None),
            ("mqtt://a b", None),
            ("http://a", None),
        ],
    )
    def test_a_brokers_url(self, url, expected):
        assert address(url) == expected
