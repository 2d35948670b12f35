// A plant drawn to scale: shapes of a sketch at one moment, with a slider and a button that plays it.
// "held": a pointer may pull it; "pull" says how far, in pixels to the right and up.
const RAMP = [[255, 247, 188], [254, 196, 79], [236, 112, 20], [153, 20, 20]];
function heat(level) {
  const at = Math.min(0.999, Math.max(0, level)) * (RAMP.length - 1), i = Math.floor(at), f = at - i;
  return `rgb(${RAMP[i].map((v, k) => Math.round(v + f * (RAMP[i + 1][k] - v))).join(",")})`;
}
export default {
  template: `
    <div class="bench-scene" v-if="scene">
      <svg :viewBox="box" role="img" :aria-label="label" preserveAspectRatio="xMidYMid meet" :style="{height: height + 'px'}"
        ref="svg" :class="{ 'is-live': held }" @pointerdown="take" @pointermove="draw" @pointerup="drop" @pointercancel="drop">
        <g transform="scale(1,-1)">
          <template v-for="(s, i) in scene.shapes" :key="i">
            <polygon v-if="closed(s)" :points="at(s)" :class="'is-' + s.style" :style="fill(s)" vector-effect="non-scaling-stroke" />
            <polyline v-else :points="at(s)" :class="'is-' + s.style" vector-effect="non-scaling-stroke" />
          </template>
        </g>
        <g class="is-scale" :transform="'translate(' + (scene.width[0] + 0.03 * span) + ',' + (-scene.height[0] - 0.03 * span) + ')'">
          <line x1="0" y1="0" :x2="bar" y2="0" vector-effect="non-scaling-stroke" />
          <text x="0" :y="-0.012 * span" :font-size="0.035 * span">{{ bar }} mm</text>
        </g>
        <line v-if="rope" class="is-pull" :x1="rope.from.x" :y1="rope.from.y" :x2="rope.to.x" :y2="rope.to.y" vector-effect="non-scaling-stroke" />
      </svg>
      <div class="bench-row" v-if="scene.t.length > 1">
        <button type="button" class="bench-play" @click="toggle" :aria-label="playing ? 'Pause' : 'Play'">{{ playing ? "❚❚" : "▶" }}</button>
        <input type="range" min="0" :max="scene.t.length - 1" step="1" v-model.number="frame" :aria-label="words" style="flex: 1" />
        <span class="bench-unit" style="min-width: 92px; text-align: right">{{ now }}</span>
      </div>
    </div>`,
  props: { scene: Object, label: String, height: Number, words: String, unit: String, seconds: Number, held: Boolean },
  data() { return { frame: 0, playing: false, rope: null }; },
  computed: {
    box() { const s = this.scene; return [s.width[0], -s.height[1], s.width[1] - s.width[0], s.height[1] - s.height[0]].join(" "); },
    span() { return Math.max(this.scene.width[1] - this.scene.width[0], this.scene.height[1] - this.scene.height[0]); },
    bar() { const want = this.span / 5, ten = 10 ** Math.floor(Math.log10(want)); return [5, 2, 1].map((k) => k * ten).find((v) => v <= want); },
    now() { return `${Number(this.scene.t[this.frame] ?? 0).toPrecision(4)} ${this.unit || ""}`; },
  },
  watch: { scene(s) { this.frame = Math.min(s?.still ?? 0, (s?.t.length ?? 1) - 1); this.playing = false; } },
  mounted() { this.frame = this.scene?.still ?? 0; },
  unmounted() { this.playing = false; },
  methods: {
    closed(s) { return ["muscle", "body", "ground", "disc"].includes(s.style); },
    at(s) { return (s.frames[this.frame] || s.frames[0]).map((p) => p.join(",")).join(" "); },
    fill(s) { return s.style === "muscle" ? { fill: heat(s.level[this.frame] ?? s.level[0]) } : {}; },
    place(e) {
      const p = new DOMPoint(e.clientX, e.clientY).matrixTransform(this.$refs.svg.getScreenCTM().inverse());
      return { x: p.x, y: p.y };
    },
    take(e) {
      if (!this.held) return;
      this.$refs.svg.setPointerCapture(e.pointerId);
      this.begin = { x: e.clientX, y: e.clientY };
      this.rope = { from: this.place(e), to: this.place(e) };
    },
    draw(e) {
      if (!this.rope) return;
      this.rope.to = this.place(e);
      const now = performance.now();
      if (now - (this.said || 0) < 40) return;
      this.said = now;
      this.$emit("pull", { x: e.clientX - this.begin.x, y: this.begin.y - e.clientY });
    },
    drop() { if (this.rope) { this.rope = null; this.$emit("pull", { x: 0, y: 0 }); } },
    toggle() {
      this.playing = !this.playing;
      if (!this.playing) return;
      const n = this.scene.t.length, whole = 1000 * (this.seconds || 4);
      const first = performance.now() - (this.frame / n) * whole;
      const step = (t) => {
        if (!this.playing) return;
        this.frame = Math.floor((((t - first) % whole) / whole) * n);
        requestAnimationFrame(step);
      };
      requestAnimationFrame(step);
    },
  },
};
