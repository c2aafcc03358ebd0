(* Whatever decide.v decides is so. *)
Require Import ZArith QArith Qreals Reals List Bool Lra Lia model decide.
Import ListNotations.
Open Scope R_scope.

Lemma strip_ok : forall b d, let '(x, y, g) := strip b d in b = (x * g)%positive /\ d = (y * g)%positive.
Proof.
  induction b; destruct d; simpl; try (rewrite ?Pos.mul_1_r; auto).
  specialize (IHb d). destruct (strip b d) as [[x y] g]. destruct IHb as [-> ->]. lia.
Qed.
Lemma qplus_ok : forall q r, Q2R (qplus q r) = Q2R q + Q2R r.
Proof.
  intros [a b] [c d]. rewrite <- Q2R_plus. apply Qeq_eqR. unfold qplus, Qeq, Qplus; cbn [Qnum Qden].
  pose proof (strip_ok b d) as S. destruct (strip b d) as [[x y] g]. destruct S as [-> ->].
  destruct a, c; cbn [Qnum Qden]; rewrite ?Pos2Z.inj_mul; ring.
Qed.
Lemma qtimes_ok : forall q r, Q2R (qtimes q r) = Q2R q * Q2R r.
Proof.
  intros [a b] [c d]. rewrite <- Q2R_mult. apply Qeq_eqR. unfold qtimes, Qeq, Qmult; cbn [Qnum Qden].
  destruct a, c; cbn [Qnum Qden]; rewrite ?Pos2Z.inj_mul; ring.
Qed.
Lemma Q2R_0 : Q2R 0 = 0. Proof. unfold Q2R; simpl; lra. Qed.
Lemma Q2R_1 : Q2R 1 = 1. Proof. unfold Q2R; simpl; lra. Qed.
Lemma Q2R_opp1 : Q2R (-1) = -1. Proof. unfold Q2R; simpl; lra. Qed.

(* The value of a linear form, and of a matrix, at v. *)
Definition val (v : list R) (r : list Q) := inner (map Q2R r) v.
Definition formQ (X : matrix) v := form (map (map Q2R) X) v.

Lemma val_plus : forall x y v, val v (rplus x y) = val v x + val v y.
Proof.
  unfold val. induction x as [|a x IH]; intros [|b y] [|c v]; simpl; try lra.
  rewrite IH, qplus_ok. lra.
Qed.
Lemma val_times : forall q x v, val v (rtimes q x) = Q2R q * val v x.
Proof. unfold val. induction x as [|a x IH]; intros [|c v]; simpl; try lra. rewrite IH, qtimes_ok. lra. Qed.
Lemma form_plus : forall X Y v, formQ (mplus X Y) v = formQ X v + formQ Y v.
Proof.
  unfold formQ. induction X as [|[|a x] X IH]; intros [|[|b y] Y] [|c v]; simpl; rewrite ?IH; try lra.
  pose proof (val_plus x y v) as E. unfold val in E. rewrite E, qplus_ok. lra.
Qed.
Lemma form_times : forall q X v, formQ (mtimes q X) v = Q2R q * formQ X v.
Proof.
  unfold formQ. induction X as [|[|a x] X IH]; intros [|c v]; simpl; rewrite ?IH; try lra.
  pose proof (val_times q x v) as E. unfold val in E. rewrite E, qtimes_ok. lra.
Qed.
Lemma form_product : forall x u v, formQ (product x u) v = val v x * val v u.
Proof.
  unfold formQ. induction x as [|a x IH]; intros [|b u] [|c v]; unfold val; simpl; try lra.
  fold (val v x). fold (val v u). rewrite IH.
  change (inner (map Q2R ?r) v) with (val v r). rewrite val_times, val_plus, !val_times, qtimes_ok.
  unfold Q2R at 3. simpl. field.
Qed.
Lemma val_combined : forall b X v, val v (combined b X) = inner (map Q2R b) (map (val v) X).
Proof.
  unfold combined, dot. induction b as [|a b IH]; intros [|x X] v; try reflexivity.
  simpl. rewrite val_plus, val_times, IH. lra.
Qed.
Lemma form_lifted : forall P X v, formQ (lifted P X) v = formQ P (map (val v) X).
Proof.
  induction P as [|[|a b] P IH]; intros [|x X] v; try reflexivity; simpl.
  - rewrite IH. reflexivity.
  - rewrite form_plus, form_product, val_plus, !val_times, val_combined, IH. unfold formQ; simpl.
    unfold Q2R at 2. simpl. field.
Qed.
Lemma form_squares : forall X v, formQ (squares X) v = norm2 (map (val v) X).
Proof.
  induction X as [|x X IH]; intros v; [unfold formQ, norm2; simpl; reflexivity|].
  simpl. rewrite form_plus, form_product, IH. unfold norm2. reflexivity.
Qed.

(* Products that are cut are not below what they were. *)
Lemma raised_ok : forall k a d, (0 <= a)%Z -> Q2R (a # d) <= Q2R (raised k a d).
Proof.
  induction k as [|k IH]; intros a d A; [simpl; lra|]. destruct d as [d|d|]; simpl; try lra.
  assert (0 <= Z.div2 a)%Z by (apply Z.div2_nonneg; auto).
  eapply Rle_trans; [|apply IH; lia]. unfold Q2R; cbn [Qnum Qden].
  replace (/ IZR (Zpos d~0)) with (/ 2 * / IZR (Zpos d)) by (rewrite <- Rinv_mult, <- mult_IZR; reflexivity).
  rewrite <- Rmult_assoc. apply Rmult_le_compat_r; [left; apply Rinv_0_lt_compat, IZR_lt; lia|].
  rewrite plus_IZR. assert (IZR a <= 2 * IZR (Z.div2 a) + 1); [|lra].
  rewrite <- mult_IZR, <- plus_IZR. apply IZR_le. rewrite Z.div2_div.
  pose proof (Z.div_mod a 2 ltac:(lia)). pose proof (Z.mod_pos_bound a 2 ltac:(lia)). lia.
Qed.
Lemma size_ok : forall q, Rabs (Q2R q) <= Q2R (size q).
Proof.
  intros [a d]. unfold size. cbn [Qnum Qden].
  assert (E : Rabs (Q2R (a # d)) = Q2R (Z.abs a # d)).
  { unfold Q2R; cbn [Qnum Qden]. rewrite Rabs_mult, <- abs_IZR. f_equal. apply Rabs_pos_eq.
    left. apply Rinv_0_lt_compat, IZR_lt. lia. }
  destruct a as [|a|a]; [unfold Q2R; simpl; rewrite !Rmult_0_l, Rabs_R0; lra | |]; rewrite E; apply raised_ok; lia.
Qed.
Lemma Q2R_sum : forall l, Q2R (fold_right qplus 0%Q l) = sum (map Q2R l).
Proof. induction l; simpl; [apply Q2R_0|]. rewrite qplus_ok, IHl. reflexivity. Qed.
Lemma norm_ok : forall x, sum (map Q2R (map size x)) <= Q2R (norm x).
Proof. intro x. unfold norm. rewrite <- Q2R_sum. eapply Rle_trans; [apply Rle_abs | apply size_ok]. Qed.

Definition major (b B : list R) := Forall2 (fun p q => Rabs p <= q) b B.
Definition squared (v : list R) := map (fun y => y * y) v.
Lemma major_size : forall x, major (map Q2R x) (map Q2R (map size x)).
Proof. unfold major. induction x; simpl; constructor; auto. apply size_ok. Qed.
Lemma major_sum : forall b B, major b B -> 0 <= sum B.
Proof. intros b B M. induction M as [|p q b B E M IH]; simpl; [lra|]. pose proof (Rabs_pos p). unfold sum in *. lra. Qed.
Lemma major_inner : forall b B v, major b B -> 0 <= inner B (squared v).
Proof.
  intros b B v M. revert v. induction M as [|p q b B E M IH]; intros [|y v]; simpl; try lra.
  pose proof (Rabs_pos p). pose proof (IH v). pose proof (Rle_0_sqr y) as S. unfold Rsqr in S. nra.
Qed.
Lemma pair_1 : forall b B, major b B -> forall y v,
  2 * Rabs (y * inner b v) <= sum B * (y * y) + inner B (squared v).
Proof.
  intros b B M. induction M as [|p q b B E M IH]; intros y [|c v]; simpl.
  - rewrite Rmult_0_r, Rabs_R0. lra.
  - rewrite Rmult_0_r, Rabs_R0. lra.
  - rewrite Rmult_0_r, Rabs_R0. pose proof (Rabs_pos p). pose proof (major_sum b B M). pose proof (Rle_0_sqr y) as S.
    unfold Rsqr, sum in *. nra.
  - rewrite Rmult_plus_distr_l. pose proof (Rabs_triang (y * (p * c)) (y * inner b v)) as T. specialize (IH y v).
    assert (2 * Rabs (y * (p * c)) <= q * (y * y) + q * (c * c)).
    { replace (y * (p * c)) with (p * (y * c)) by ring. rewrite Rabs_mult.
      assert (2 * Rabs (y * c) <= y * y + c * c).
      { pose proof (Rle_0_sqr (y - c)) as S1. pose proof (Rle_0_sqr (y + c)) as S2. unfold Rsqr in *.
        unfold Rabs. destruct (Rcase_abs (y * c)); lra. }
      pose proof (Rabs_pos p). pose proof (Rabs_pos (y * c)).
      pose proof (Rmult_le_compat (Rabs p) q (2 * Rabs (y * c)) (y * y + c * c)). lra. }
    unfold sum in *. lra.
Qed.
Lemma pair_2 : forall a A b B, major a A -> major b B -> forall u v,
  2 * Rabs (inner a u * inner b v) <= sum B * inner A (squared u) + sum A * inner B (squared v).
Proof.
  intros a A b B MA MB. induction MA as [|p q a A E MA IH]; intros u v; [simpl; rewrite !Rmult_0_l, Rabs_R0; lra|].
  pose proof (major_sum a A MA). pose proof (major_sum b B MB). pose proof (major_inner b B v MB). pose proof (Rabs_pos p).
  destruct u as [|y u]; simpl; [rewrite Rmult_0_l, Rabs_R0; unfold sum in *; nra|].
  rewrite Rmult_plus_distr_r. pose proof (Rabs_triang (p * y * inner b v) (inner a u * inner b v)) as T.
  specialize (IH u v). pose proof (pair_1 b B MB y v) as O.
  replace (p * y * inner b v) with (p * (y * inner b v)) in * by ring. rewrite Rabs_mult in T.
  pose proof (Rabs_pos (y * inner b v)). unfold sum in *. nra.
Qed.
Lemma form_diagonal : forall r v, formQ (diagonal r) v = inner (map Q2R r) (squared v).
Proof. unfold formQ. induction r as [|q r IH]; intros [|y v]; simpl; auto. rewrite IH. ring. Qed.
Lemma shadow_ok : forall x u v, Rabs (val v x * val v u) <= formQ (diagonal (shadow x u)) v.
Proof.
  intros x u v. rewrite form_diagonal. unfold shadow. change (inner (map Q2R ?r) ?s) with (val s r).
  rewrite val_times, val_plus, !val_times. unfold val.
  pose proof (pair_2 _ _ _ _ (major_size x) (major_size u) v v) as P. pose proof (norm_ok x). pose proof (norm_ok u).
  pose proof (major_inner _ _ v (major_size x)). pose proof (major_inner _ _ v (major_size u)).
  replace (Q2R (1 # 2)) with (/ 2) by (unfold Q2R; simpl; lra). nra.
Qed.
Lemma val_minus : forall x y v, val v (rminus x y) = val v x - val v y.
Proof. intros. unfold rminus. rewrite val_plus, val_times, Q2R_opp1. lra. Qed.
Lemma form_product_above : forall d x u v, val v x * val v u <= formQ (product_above d x u) v.
Proof.
  intros d x u v. unfold product_above. cbv zeta. set (x' := map (cut d) x). set (u' := map (cut d) u).
  rewrite form_plus, form_product, form_diagonal. change (inner (map Q2R ?r) ?s) with (val s r).
  rewrite val_plus. unfold val at 5 6. rewrite <- !form_diagonal.
  pose proof (shadow_ok (rminus x x') u v) as E1. pose proof (shadow_ok x' (rminus u u') v) as E2.
  rewrite val_minus in E1, E2.
  pose proof (Rle_abs ((val v x - val v x') * val v u)). pose proof (Rle_abs (val v x' * (val v u - val v u'))). lra.
Qed.
Lemma form_lifted_above : forall d P X v, formQ P (map (val v) X) <= formQ (lifted_above d P X) v.
Proof.
  induction P as [|[|a b] P IH]; intros [|x X] v; try (simpl; destruct v; simpl; unfold formQ; simpl; lra); simpl.
  - apply IH.
  - rewrite form_plus. specialize (IH X v).
    pose proof (form_product_above d x (rplus (rtimes a x) (rtimes 2 (combined b X))) v) as E.
    rewrite val_plus, !val_times, val_combined in E. unfold formQ at 1; cbn [map form].
    replace (Q2R 2) with 2 in E by (unfold Q2R; simpl; lra). unfold formQ at 1 in IH. nra.
Qed.

Lemma inner_zero : forall b x, zero x -> inner b x = 0.
Proof. induction b; intros x Z; destruct Z as [|y x E Z]; simpl; auto. rewrite E, IHb; auto. lra. Qed.
Lemma form_zero : forall P x, zero x -> form P x = 0.
Proof.
  induction P as [|[|a b] P IH]; intros x Z; destruct Z as [|y x E Z]; simpl; auto.
  rewrite E, IH, inner_zero by auto. lra.
Qed.

(* Chances. *)
Fixpoint value (ps : list Q) (o : list bool) (v : list R) (t : random) : R :=
  match t with
  | Zero => 0
  | Row r => val v r
  | Node a b => value (tl ps) (tl o) v a + ((if hd false o then 1 else 0) - Q2R (hd 0%Q ps)) * value (tl ps) (tl o) v b end.
Lemma value_onto : forall t r ps o v, value ps o v (onto r t) = val v r + value ps o v t.
Proof. induction t; intros; simpl; [lra | apply val_plus | rewrite IHt1; lra]. Qed.
Lemma value_plus : forall s t ps o v, value ps o v (tplus s t) = value ps o v s + value ps o v t.
Proof.
  induction s; intros t ps o v; [simpl; lra | simpl; apply value_onto|].
  destruct t; simpl; [lra | rewrite value_onto; lra | rewrite IHs1, IHs2; lra].
Qed.
Lemma value_times : forall t q ps o v, value ps o v (ttimes q t) = Q2R q * value ps o v t.
Proof. induction t; intros; simpl; [lra | apply val_times | rewrite IHt1, IHt2; lra]. Qed.
Lemma others_ok : forall p, Q2R (others p) = 1 - Q2R p.
Proof. intro p. unfold others. rewrite qplus_ok, qtimes_ok, Q2R_1, Q2R_opp1. lra. Qed.
Lemma value_split : forall t ps o v, value ps o v t =
  value (tl ps) (tl o) v (left t) + ((if hd false o then 1 else 0) - Q2R (hd 0%Q ps)) * value (tl ps) (tl o) v (right t).
Proof.
  destruct t; intros; simpl; try lra.
Qed.
Lemma value_chance : forall k t ps o v, value ps o v (tchance ps k t) = thrown o k (value ps o v t).
Proof.
  unfold thrown. induction k as [|k IH]; intros t ps o v; simpl.
  - rewrite value_times, value_plus, value_times, others_ok. rewrite (value_split t ps o v).
    destruct o as [|[|] o]; simpl; lra.
  - rewrite !IH. rewrite (value_split t ps o v). destruct o as [|c o]; simpl; [destruct k; lra|].
    destruct (nth k o false); lra.
Qed.

(* The mean of a quadratic form of what is left to chance. *)
Lemma form_line : forall {T} (P : list (list R)) (f g : T -> R) (ts : list T), exists b, forall c,
  form P (map (fun t => f t + c * g t) ts) = form P (map f ts) + c * b + c * c * form P (map g ts).
Proof.
  assert (I : forall {T} (b : list R) (f g : T -> R) ts c, inner b (map (fun t => f t + c * g t) ts) =
    inner b (map f ts) + c * inner b (map g ts)).
  { intros T b f g. induction b as [|a b IH]; intros [|t ts] c; simpl; try lra. rewrite IH. lra. }
  intros T P f g. induction P as [|[|a b] P IH]; intros [|t ts]; simpl.
  1, 2, 3, 5: exists 0; intro; lra.
  - destruct (IH ts) as [d E]. exists d. intro c. rewrite E. lra.
  - destruct (IH ts) as [d E].
    exists (2 * a * f t * g t + 2 * f t * inner b (map g ts) + 2 * g t * inner b (map f ts) + d).
    intro c. rewrite E, I. lra.
Qed.
Lemma mean_ext : forall ps g h, (forall o, g o = h o) -> mean ps g = mean ps h.
Proof. induction ps; simpl; intros g h E; auto. f_equal; f_equal; apply IHps; auto. Qed.
Lemma mean_line : forall ps g h c, mean ps (fun o => g o + c * h o) = mean ps g + c * mean ps h.
Proof. induction ps; simpl; intros; auto. rewrite !IHps. lra. Qed.
Lemma mean_zero : forall ps g, (forall o, g o = 0) -> mean ps g = 0.
Proof. induction ps as [|p ps IH]; simpl; intros g E; auto. rewrite !IH by auto. lra. Qed.
Lemma mean_times : forall ps g c, mean ps (fun o => c * g o) = c * mean ps g.
Proof.
  intros ps g c. rewrite (mean_ext _ _ (fun o => 0 + c * g o)) by (intro; lra).
  rewrite (mean_line ps (fun _ => 0)), mean_zero by auto. lra.
Qed.
Lemma probable_ok : forall p, probable p = true -> 0 <= Q2R p <= 1.
Proof.
  intros p P. apply andb_true_iff in P as [A B]. apply Qle_bool_iff, Qle_Rle in A. apply Qle_bool_iff, Qle_Rle in B.
  rewrite Q2R_0 in A. rewrite Q2R_1 in B. auto.
Qed.
Lemma mean_spread : forall d ps P ts v, forallb probable ps = true ->
  mean ps (fun o => formQ P (map (value ps o v) ts)) <= formQ (spread d P ps ts) v.
Proof.
  induction ps as [|p ps IH]; intros P ts v G.
  - simpl. eapply Rle_trans; [|apply form_lifted_above]. rewrite map_map. apply Req_le. f_equal. apply map_ext.
    induction a; simpl; unfold val; simpl; auto; try (destruct v; reflexivity).
    rewrite Q2R_0. unfold val in IHa1. rewrite IHa1. lra.
  - simpl in G. apply andb_true_iff in G as [Gp G]. apply probable_ok in Gp.
    assert (S : forall c o, formQ P (map (value (p :: ps) (c :: o) v) ts) =
      formQ P (map (fun t => value ps o v (left t) + ((if c : bool then 1 else 0) - Q2R p) * value ps o v (right t)) ts)).
    { intros c o. f_equal. apply map_ext. intro t. rewrite value_split. reflexivity. }
    assert (E : forall o, Q2R p * formQ P (map (value (p :: ps) (true :: o) v) ts) +
      (1 - Q2R p) * formQ P (map (value (p :: ps) (false :: o) v) ts) =
      formQ P (map (value ps o v) (map left ts)) + Q2R p * (1 - Q2R p) * formQ P (map (value ps o v) (map right ts))).
    { intro o. rewrite !S, !map_map. unfold formQ.
      destruct (form_line (map (map Q2R) P) (fun t => value ps o v (left t)) (fun t => value ps o v (right t)) ts) as [b L].
      rewrite !L. lra. }
    apply Rle_trans with (mean ps (fun o => formQ P (map (value ps o v) (map left ts)) +
      (Q2R p * (1 - Q2R p)) * formQ P (map (value ps o v) (map right ts)))).
    + apply Req_le. simpl. rewrite <- (mean_ext _ _ _ E), mean_line, mean_times. reflexivity.
    + rewrite mean_line. simpl. rewrite form_plus. apply Rplus_le_compat; [apply IH; auto|].
      assert (0 <= Q2R p * (1 - Q2R p)) by nra.
      destruct (forallb nothing (map right ts)) eqn:N.
      * apply Req_le. replace (formQ [] v) with 0 by (destruct v; reflexivity).
        rewrite mean_zero; [lra|]. intro o. apply form_zero. unfold zero. rewrite Forall_map, Forall_forall. intros t I.
        rewrite forallb_forall in N. specialize (N t I). destruct t; try discriminate. reflexivity.
      * rewrite form_times, qtimes_ok, others_ok. apply Rmult_le_compat_l; auto.
Qed.

Definition near p q := -2 <= p - q <= 2.
Definition RZ := map (map IZR).
Lemma down_ok : forall b a, down a b = (a / Zpos b)%Z.
Proof.
  induction b; intro a; simpl; auto; [|now rewrite Z.div_1_r].
  rewrite IHb, Z.div2_div, Z.div_div by lia. reflexivity.
Qed.
Lemma floor_near : forall a b, (0 < b)%Z -> IZR (a / b) <= IZR a / IZR b <= IZR (a / b) + 1.
Proof.
  intros a b B. assert (P := IZR_lt _ _ B). simpl in P.
  pose proof (Z.div_mod a b ltac:(lia)) as E. pose proof (Z.mod_pos_bound a b B) as [L U].
  apply (f_equal IZR) in E. rewrite plus_IZR, mult_IZR in E.
  apply IZR_le in L. apply IZR_lt in U. simpl in L.
  split; apply (Rmult_le_reg_r (IZR b)); auto; unfold Rdiv; rewrite Rmult_assoc, Rinv_l by lra; lra.
Qed.
Lemma norm2_cons : forall y x, norm2 (y :: x) = y * y + norm2 x.
Proof. reflexivity. Qed.
Lemma norm2_pos : forall x, 0 <= norm2 x.
Proof. induction x; [unfold norm2; simpl; lra|]. rewrite norm2_cons. nra. Qed.
Definition zero_or : forall x, zero x \/ ~ zero x.
Proof. intro x. destruct (Forall_dec (fun y => y = 0) (fun y => Req_EM_T y 0) x); auto. Qed.

Lemma triangle_map : forall {S T} (g : S -> T) k X, triangle k (map (map g) X) = triangle k X.
Proof. induction k; destruct X; simpl; auto. rewrite map_length, IHk. reflexivity. Qed.
Lemma form_lowered : forall k c Y v, triangle k Y = true -> length v = k ->
  form (RZ (lowered c Y)) v = form (RZ Y) v - IZR c * norm2 v.
Proof.
  induction k; intros c [|[|a b] Y] [|y v] T L; simpl in *; try discriminate; [unfold norm2; simpl; lra|].
  apply andb_true_iff in T as [_ T]. rewrite IHk by (auto; lia). rewrite norm2_cons, minus_IZR. lra.
Qed.
Lemma inner_near : forall b d x y, Forall2 near b d ->
  2 * y * inner d x - 2 * (INR (length b) * (y * y)) - 2 * norm2 x <= 2 * y * inner b x.
Proof.
  induction b as [|p b IH]; intros d x y N; inversion N as [|? q ? d' E N']; subst.
  - simpl. pose proof (norm2_pos x). destruct x; lra.
  - destruct x as [|c x].
    { cbn [inner]. pose proof (pos_INR (length (p :: b))). unfold norm2. simpl (sum _).
      pose proof (Rle_0_sqr y) as S. unfold Rsqr in S. pose proof (Rmult_le_pos _ _ H S). lra. }
    specialize (IH d' x y N'). rewrite norm2_cons. cbn [inner]. change (length (p :: b)) with (S (length b)). rewrite S_INR.
    assert (- (2 * (y * y) + 2 * (c * c)) <= 2 * y * ((p - q) * c)); [|lra].
    unfold near in E. set (e := p - q) in *.
    assert (0 <= (2 * y + e * c) * (2 * y + e * c)) by apply Rle_0_sqr.
    assert (e * e <= 4) by nra. nra.
Qed.
Lemma form_near : forall k X Y v, Forall2 (Forall2 near) X Y -> triangle k X = true ->
  length v = k -> form Y v - 2 * INR k * norm2 v <= form X v.
Proof.
  induction k as [|k IH]; intros X Y v N T L; destruct v as [|y v]; try discriminate.
  - destruct X; try discriminate. inversion N; subst. unfold norm2; simpl; lra.
  - destruct X as [|[|a b] X]; try discriminate. simpl in T. apply andb_true_iff in T as [B T]. apply Nat.eqb_eq in B.
    injection L as L.
    inversion N as [|? R ? Y' N1 N2]; subst. inversion N1 as [|? c ? d E N3]; subst.
    specialize (IH X Y' v N2 T L). pose proof (inner_near b d v y N3) as I.
    rewrite norm2_cons, S_INR. unfold near in E. cbn [form]. pose proof (Rle_0_sqr y) as S. unfold Rsqr in S.
    pose proof (Rmult_le_pos (a - c + 2) (y * y) ltac:(lra) S). lra.
Qed.
Lemma inner_rest : forall a row b f x, length row = length b ->
  inner (rest_row (fun c p q => c - p * q / a) row f b) x = inner row x - f * inner b x / a.
Proof.
  induction row as [|c row IH]; intros [|g b] f [|y x] L; simpl in *; try discriminate; try (unfold Rdiv; ring).
  rewrite IH by lia. unfold Rdiv; ring.
Qed.
Definition kept (c : R) := c.
Lemma form_rest : forall a X b x, triangle (length b) X = true ->
  form (rest kept (fun c p q => c - p * q / a) X b) x = form X x - inner b x * inner b x / a.
Proof.
  induction X as [|row X IH]; intros [|f b] x T; simpl in T; try discriminate; [destruct x; simpl; unfold Rdiv; ring|].
  apply andb_true_iff in T as [L T]. apply Nat.eqb_eq in L. destruct row as [|c row]; [discriminate|]. injection L as L.
  destruct x as [|y x]; [simpl; unfold Rdiv; ring|]. cbn [rest rest_row form inner]. unfold kept at 1 2 3.
  rewrite inner_rest, IH by auto. unfold Rdiv; ring.
Qed.
Section Rest.
Variables (a p : Z).
Hypotheses (A : (0 < a)%Z) (P : (0 <= p)%Z).
Definition share c := (c * 2 ^ p / a)%Z.
Definition left_over c b_i b_j := (c - down (b_i * b_j) (Z.to_pos (2 ^ p)))%Z.
Lemma entry_near : forall c f g, (Z.abs g <= 2 ^ p)%Z ->
  near (IZR c - IZR f * IZR g / IZR a) (IZR (left_over c (share f) g)).
Proof.
  intros c f g G. unfold left_over, share. rewrite down_ok. assert (T : (0 < 2 ^ p)%Z) by (apply Z.pow_pos_nonneg; lia).
  rewrite Z2Pos.id by auto. set (t := (2 ^ p)%Z) in *. assert (A' := IZR_lt _ _ A). assert (T' := IZR_lt _ _ T). simpl in A', T'.
  pose proof (floor_near (f * t) a A) as N1. set (s := (f * t / a)%Z) in *.
  pose proof (floor_near (s * g) t T) as N2. rewrite mult_IZR in N1, N2. rewrite minus_IZR.
  apply IZR_le in G. rewrite abs_IZR in G. unfold near.
  assert (E : IZR f * IZR g / IZR a = (IZR f * IZR t / IZR a) * IZR g / IZR t) by (field; lra).
  rewrite E. set (r := IZR f * IZR t / IZR a) in *.
  assert (D : -1 <= (r - IZR s) * IZR g / IZR t <= 1).
  { assert (Rabs ((r - IZR s) * IZR g) <= 1 * IZR t).
    { rewrite Rabs_mult. apply Rmult_le_compat; auto using Rabs_pos. rewrite Rabs_pos_eq; lra. }
    assert (B : - IZR t <= (r - IZR s) * IZR g <= IZR t) by (unfold Rabs in H; destruct (Rcase_abs _) in H; lra).
    split; apply (Rmult_le_reg_r (IZR t)); auto; unfold Rdiv; rewrite Rmult_assoc, Rinv_l by lra; lra. }
  replace (r * IZR g / IZR t) with (IZR s * IZR g / IZR t + (r - IZR s) * IZR g / IZR t) by (field; lra). lra.
Qed.
Lemma rest_row_near : forall row f b, forallb (fun c => Z.abs c <=? 2 ^ p)%Z b = true -> Forall2 near
  (rest_row (fun c p q => c - p * q / IZR a) (map IZR row) (IZR f) (map IZR b))
  (map IZR (rest_row left_over row (share f) b)).
Proof.
  induction row as [|c row IH]; intros f [|g b] G; simpl; constructor; simpl in G; apply andb_true_iff in G as [G1 G2]; auto.
  apply entry_near. apply Z.leb_le. auto.
Qed.
Lemma rest_near : forall X b, forallb (fun c => Z.abs c <=? 2 ^ p)%Z b = true -> Forall2 (Forall2 near)
  (rest kept (fun c p q => c - p * q / IZR a) (RZ X) (map IZR b)) (RZ (rest share left_over X b)).
Proof.
  induction X as [|row X IH]; intros [|f b] G; try (simpl; constructor).
  - exact (rest_row_near row f (f :: b) G).
  - apply IH. simpl in G. apply andb_true_iff in G as [_ G]. auto.
Qed.
End Rest.
Lemma rest_row_length : forall {T} (op : T -> T -> T -> T) row f b, length row = length b -> length (rest_row op row f b) = length b.
Proof. induction row as [|c row IH]; intros f [|g b] L; simpl in *; try discriminate; auto. Qed.
Lemma rest_triangle : forall {T} (g : T -> T) (op : T -> T -> T -> T) k X b,
  triangle k X = true -> length b = k -> triangle k (rest g op X b) = true.
Proof.
  induction k as [|k IH]; intros [|row X] [|f b] T1 L; simpl in *; try discriminate; auto.
  apply andb_true_iff in T1 as [R T1]. apply Nat.eqb_eq in R. rewrite rest_row_length by (simpl; lia). simpl.
  injection L as L. rewrite IH by auto. rewrite L. now rewrite Nat.eqb_refl.
Qed.

Lemma definite : forall k X v, positive_definite k X = true -> length v = k -> ~ zero v -> 0 < form (RZ X) v.
Proof.
  induction k as [|k IH]; intros X v P L N; destruct v as [|y v]; try discriminate.
  - exfalso; apply N; constructor.
  - destruct X as [|[|a b] X]; try discriminate. cbn [positive_definite] in P. cbv zeta in P. injection L as L.
    apply andb_true_iff in P as [P R]. apply andb_true_iff in P as [P G]. apply andb_true_iff in P as [P T].
    apply andb_true_iff in P as [A B]. apply Z.ltb_lt in A. apply Nat.eqb_eq in B. assert (A' := IZR_lt _ _ A). simpl in A'.
    assert (P0 : (0 <= places b)%Z).
    { unfold places. assert (0 <= fold_right Z.max 0 (map (fun c => Z.log2 (Z.abs c)) b))%Z by (clear; induction b; simpl; lia). lia. }
    change (rest _ _ X b) with (rest (share a (places b)) (left_over (places b)) X b) in R.
    set (rst := rest (share a (places b)) (left_over (places b)) X b) in *.
    assert (T' : triangle k rst = true) by (apply rest_triangle; auto).
    assert (F : form (RZ (lowered (2 * Z.of_nat k) rst)) v <= form (RZ X) v - inner (map IZR b) v * inner (map IZR b) v / IZR a).
    { rewrite (form_lowered k) by auto. rewrite mult_IZR, <- INR_IZR_INZ.
      rewrite <- (form_rest (IZR a) (RZ X) (map IZR b) v) by (rewrite map_length, B; unfold RZ; now rewrite triangle_map).
      apply form_near; auto; [now apply rest_near|].
      apply rest_triangle; [unfold RZ; now rewrite triangle_map | now rewrite map_length]. }
    change (form (RZ ((a :: b) :: X)) (y :: v)) with (IZR a * y * y + 2 * y * inner (map IZR b) v + form (RZ X) v).
    set (i := inner (map IZR b) v) in *. set (q := form (RZ X) v) in *.
    assert (E : IZR a * y * y + 2 * y * i + q = IZR a * ((y + i / IZR a) * (y + i / IZR a)) + (q - i * i / IZR a)) by (field; lra).
    rewrite E. pose proof (Rle_0_sqr (y + i / IZR a)) as S. unfold Rsqr in S.
    destruct (zero_or v) as [Z|Z].
    + assert (i = 0) as I by (apply inner_zero; auto). assert (q = 0) as Q0 by (apply form_zero; auto).
      rewrite I, Q0. assert (y <> 0) by (intro; apply N; constructor; auto).
      replace (y + 0 / IZR a) with y by (field; lra). replace (0 - 0 * 0 / IZR a) with 0 by (field; lra).
      assert (0 < y * y) by nra. nra.
    + specialize (IH _ v R L Z). apply Rplus_le_lt_0_compat; [apply Rmult_le_pos; lra | lra].
Qed.

Lemma padded_cons : forall k r, padded (S k) r = hd 0%Q r :: padded k (tl r).
Proof.
  intros k r. unfold padded. simpl. rewrite <- seq_shift, map_map. f_equal; [destruct r; auto|].
  apply map_ext. intro i. destruct r; simpl; destruct i; auto.
Qed.
Lemma inner_padded : forall k r v, length v = k -> inner (map Q2R (padded k r)) v = inner (map Q2R r) v.
Proof.
  induction k as [|k IH]; intros r [|y v] L; try discriminate; [destruct r; reflexivity|].
  injection L as L. rewrite padded_cons. simpl. rewrite IH by auto. destruct r as [|a r]; simpl; rewrite ?Q2R_0; lra.
Qed.
Lemma form_whole : forall k X v, length v = k -> formQ (whole k X) v = formQ X v.
Proof.
  unfold formQ. induction k as [|k IH]; intros X [|y v] L; try discriminate; [destruct X as [|[|]]; reflexivity|].
  injection L as L. cbn [whole map]. rewrite padded_cons. cbn [map form]. rewrite IH, inner_padded by auto.
  destruct X as [|[|a b] X]; cbn [hd tl map form inner]; rewrite ?Q2R_0; try (destruct v; simpl; lra); lra.
Qed.
Lemma whole_triangle : forall k X, triangle k (whole k X) = true.
Proof. induction k as [|k IH]; intro X; simpl; auto. rewrite map_length, seq_length, IH. now rewrite Nat.eqb_refl. Qed.
Lemma none_ok : forall q, none q = true -> Q2R q = 0.
Proof. intros q E. apply Qeq_bool_iff in E. rewrite (Qeq_eqR _ _ E). apply Q2R_0. Qed.
Lemma inner_none : forall r v, forallb none r = true -> inner (map Q2R r) v = 0.
Proof.
  induction r as [|a r IH]; intros [|y v] N; simpl in *; auto. apply andb_true_iff in N as [A N].
  rewrite IH, none_ok by auto. lra.
Qed.
Lemma form_none : forall X v, forallb (forallb none) X = true -> formQ X v = 0.
Proof.
  unfold formQ. induction X as [|[|a b] X IH]; intros [|y v] N; simpl in *; auto.
  apply andb_true_iff in N as [R N]. apply andb_true_iff in R as [A R]. rewrite IH, inner_none, none_ok by auto. lra.
Qed.
Lemma inner_within : forall k r v u, length v = k -> forallb none (skipn k r) = true ->
  inner (map Q2R r) (v ++ u) = inner (map Q2R r) v.
Proof.
  induction k as [|k IH]; intros r [|y v] u L N; try discriminate; destruct r as [|a r]; auto.
  - apply (inner_none (a :: r) u N).
  - simpl in *. rewrite IH; auto.
Qed.
Lemma form_within : forall X k v u, length v = k -> within k X = true -> formQ X (v ++ u) = formQ X v.
Proof.
  induction X as [|row X IH]; intros k [|y v] u L W; try reflexivity.
  - subst k. simpl app. rewrite (form_none (row :: X) u W). unfold formQ. simpl. destruct (map Q2R row); reflexivity.
  - subst k. simpl in W. apply andb_true_iff in W as [R W]. specialize (IH (length v) v u eq_refl W).
    unfold formQ in *. simpl. destruct row as [|a b]; simpl in *; auto. rewrite IH, (inner_within (length v)) by auto. reflexivity.
Qed.
Lemma rounded_near : forall X, Forall2 (Forall2 near) (map (map Q2R) X) (RZ (rounded X)).
Proof.
  unfold RZ, rounded. induction X as [|r X IH]; simpl; constructor; auto. clear IH.
  induction r as [|[a b] r IH]; simpl; constructor; auto.
  rewrite down_ok. unfold near, Q2R; simpl. pose proof (floor_near a (Zpos b) eq_refl). unfold Rdiv in *. lra.
Qed.
Lemma first_ok : forall ok digits, first ok digits = true -> exists d, ok d = true.
Proof.
  induction digits as [|d digits IH]; simpl; [discriminate|]. destruct (ok d) eqn:E; [eauto|]. apply IH.
Qed.
Lemma positive_ok : forall k X, positive k X = true -> exists d, within k (X d) = true /\
  forall v u, length v = k -> ~ zero v -> 0 < formQ (X d) (v ++ u).
Proof.
  intros k X P. apply first_ok in P as [d P]. exists d. apply andb_true_iff in P as [W D]. split; auto. intros v u L N.
  rewrite (form_within (X d) k) by auto. apply definite with (v := v) in D; auto.
  set (unit := inject_Z (2 ^ Z.of_nat d)) in *. set (Y := mtimes unit (whole k (X d))) in *.
  assert (U : 0 <= Q2R unit) by (unfold unit, inject_Z, Q2R; simpl; rewrite Rinv_1, Rmult_1_r; apply IZR_le, Z.pow_nonneg; lia).
  assert (T : triangle k Y = true) by (unfold Y, mtimes, rtimes; rewrite triangle_map; apply whole_triangle).
  assert (F : formQ Y v = Q2R unit * formQ (X d) v) by (unfold Y; rewrite form_times, form_whole; auto).
  rewrite (form_lowered k) in D by (auto; unfold rounded; now rewrite triangle_map).
  pose proof (form_near k _ _ v (rounded_near Y) ltac:(now rewrite triangle_map) L) as G.
  rewrite mult_IZR, <- INR_IZR_INZ in D. fold (formQ Y v) in G. rewrite F in G. nra.
Qed.

(* What the model says of linear forms, it says of their values. *)
Section Values.
Variables (T U : Type) (null : T) (plus : T -> T -> T) (by_ : Q -> T -> T) (chance : nat -> T -> T).
Variables (null' : U) (plus' : U -> U -> U) (by' : Q -> U -> U) (chance' : nat -> U -> U) (h : T -> U) (f : network).
Hypothesis h_null : h null = null'.
Hypothesis h_plus : forall a b, h (plus a b) = plus' (h a) (h b).
Hypothesis h_by : forall q a, h (by_ q a) = by' q (h a).
Hypothesis h_chance : forall k a, h (chance k a) = chance' k (h a).
Definition h_st (st : state T) : state U := (map h (fst st), map (map h) (snd st)).

Lemma h_add : forall x y, map h (add T plus x y) = add U plus' (map h x) (map h y).
Proof. unfold add. induction x; intros [|b y]; simpl; auto. rewrite h_plus, IHx. reflexivity. Qed.
Lemma h_scale : forall q x, map h (scale T by_ q x) = scale U by' q (map h x).
Proof. intros. unfold scale. rewrite !map_map. apply map_ext. auto. Qed.
Lemma h_sub : forall x y, map h (sub T plus by_ x y) = sub U plus' by' (map h x) (map h y).
Proof. intros. unfold sub. rewrite h_add, h_scale. reflexivity. Qed.
Lemma h_dot : forall r x, h (dot T null plus by_ r x) = dot U null' plus' by' r (map h x).
Proof. unfold dot. induction r; intros [|b x]; simpl; auto. rewrite h_plus, h_by, IHr. reflexivity. Qed.
Lemma h_act : forall X x, map h (act T null plus by_ X x) = act U null' plus' by' X (map h x).
Proof. intros. unfold act. rewrite map_map. apply map_ext. intro. apply h_dot. Qed.
Lemma h_sized : forall k x, map h (sized T null k x) = sized U null' k (map h x).
Proof. intros. unfold sized. rewrite map_map. apply map_ext. intro. rewrite <- h_null, map_nth. reflexivity. Qed.
Lemma h_sometimes : forall k x, map h (sometimes T chance f k x) = sometimes U chance' f k (map h x).
Proof. intros. unfold sometimes. destruct (Qeq_bool _ _); auto. rewrite !map_map. apply map_ext. auto. Qed.
Lemma h_estimate : forall st j, map h (estimate T st j) = estimate U (h_st st) j.
Proof. intros. unfold estimate, h_st. simpl. symmetry. apply (map_nth (map h) (snd st) []). Qed.
Lemma h_innovation : forall st w j, map h (innovation T null plus by_ chance f st w j) =
  innovation U null' plus' by' chance' f (h_st st) (map h w) j.
Proof.
  intros. unfold innovation. cbv zeta. destruct (seen (node f j));
  rewrite ?h_sometimes, ?h_sub, ?h_add, ?h_sometimes, ?h_scale, !h_act, h_estimate; reflexivity.
Qed.
Lemma h_weighed : forall s i j X x, map h (weighed T null plus by_ f s i j X x) = weighed U null' plus' by' f s i j X (map h x).
Proof. intros. unfold weighed. rewrite h_scale, h_act. reflexivity. Qed.
Lemma h_message : forall s st w i j, map h (message T null plus by_ chance f s st w i j) =
  message U null' plus' by' chance' f s (h_st st) (map h w) i j.
Proof. intros. unfold message. rewrite h_sometimes, h_add, !h_weighed, h_sub, !h_estimate, h_innovation. reflexivity. Qed.
Lemma h_fold : forall {I} (a : I -> list T) (a' : I -> list U) l x y, map h x = y -> (forall i, map h (a i) = a' i) ->
  map h (fold_right (add T plus) x (map a l)) = fold_right (add U plus') y (map a' l).
Proof. intros I a a' l x y E F. induction l; simpl; auto. rewrite h_add, F, IHl. reflexivity. Qed.
Lemma h_alone : forall s st i, map h (alone T null plus by_ f s st i) = alone U null' plus' by' f s (h_st st) i.
Proof.
  intros. unfold alone. destruct (unbiased f); [rewrite h_act, h_estimate; reflexivity|].
  apply h_fold; [rewrite h_sized; reflexivity|]. intro. rewrite h_weighed, h_estimate. reflexivity.
Qed.
Lemma h_step : forall s st w, h_st (step T null plus by_ chance f s st w) =
  step U null' plus' by' chance' f s (h_st st) (map h w).
Proof.
  intros. unfold step, h_st at 1. simpl. f_equal; [rewrite h_sized, h_add, !h_act; reflexivity|].
  rewrite map_map. apply map_ext. intro i. rewrite h_sized. f_equal. apply h_fold; [apply h_alone|]. intro. apply h_message.
Qed.
Lemma h_errors : forall st, map (map h) (errors T plus by_ st) = errors U plus' by' (h_st st).
Proof. intros. unfold errors, h_st. simpl. rewrite !map_map. apply map_ext. intro. apply h_sub. Qed.
Lemma h_z : forall st, map h (z T null plus by_ f st) = z U null' plus' by' f (h_st st).
Proof.
  intros. unfold z. rewrite <- h_errors, concat_map, map_map. f_equal.
  generalize (nodes f) as vs. generalize (errors T plus by_ st) as es. intros es vs. revert es.
  induction vs; intros [|e es]; simpl; auto. rewrite IHvs, h_scale, h_act. reflexivity.
Qed.
Lemma h_eta : forall x st, map h (eta T plus by_ x st) = eta U plus' by' x (h_st st).
Proof. intros. unfold eta. rewrite map_app, concat_map, h_errors. destruct x; reflexivity. Qed.
End Values.

(* v = [w; e_1; ...; e_n; x] has the values that its linear forms are to have. *)
Lemma val_axis : forall k v, val v (axis k) = nth k v 0.
Proof.
  unfold axis, val. induction k as [|k IH]; intros [|y v]; simpl; auto.
  - rewrite Q2R_1. destruct v; simpl; lra.
  - rewrite IH, Q2R_0. lra.
Qed.
Lemma axes : forall k m v, map (val v) (map axis (seq k m)) = map (fun i => nth i v 0) (seq k m).
Proof. intros. rewrite map_map. apply map_ext. intro. apply val_axis. Qed.
Lemma part : forall b a c, map (fun i => nth i (a ++ b ++ c) 0) (seq (length a) (length b)) = b.
Proof.
  induction b as [|y b IH]; intros a c; simpl; auto. f_equal.
  - rewrite app_nth2 by lia. rewrite Nat.sub_diag. reflexivity.
  - specialize (IH (a ++ [y]) c). rewrite app_length in IH. simpl in IH.
    replace (length a + 1)%nat with (S (length a)) in IH by lia. rewrite <- app_assoc in IH. exact IH.
Qed.
Lemma parts : forall m es a c, Forall (fun e => length e = m) es ->
  map (fun i => map (fun k => nth k (a ++ concat es ++ c) 0) (seq (length a + i * m) m)) (seq 0 (length es)) = es.
Proof.
  induction es as [|e es IH]; intros a c F; simpl; auto. inversion F as [|? ? L F']; subst. f_equal.
  - rewrite Nat.add_0_r, <- app_assoc. apply part.
  - rewrite <- seq_shift, map_map. specialize (IH (a ++ e) c F'). rewrite <- IH at 2. apply map_ext. intro i.
    rewrite app_length, <- !app_assoc. replace (length a + S i * length e)%nat with (length a + length e + i * length e)%nat by lia.
    reflexivity.
Qed.
Lemma concat_length : forall {T} m (es : list (list T)), Forall (fun e => length e = m) es -> length (concat es) = (length es * m)%nat.
Proof. induction es as [|e es IH]; intro F; simpl; auto. inversion F; subst. rewrite app_length, IH; auto. Qed.

Notation subR := (sub R Rplus times).
Notation errorsR := (errors R Rplus times).
Notation etaR := (eta R Rplus times).
Lemma sub_length : forall x y, length x = length y -> length (subR x y) = length x.
Proof. intros x y L. unfold sub, add, scale. rewrite map_length, combine_length, map_length, L. apply Nat.min_id. Qed.
Lemma sub_sub : forall x y, length x = length y -> subR x (subR x y) = y.
Proof.
  induction x as [|a x IH]; intros [|b y] L; simpl in L; try discriminate; auto. injection L as L.
  specialize (IH y L). unfold sub, add, scale, times in *. simpl. rewrite IH, Q2R_opp1. f_equal. lra.
Qed.
Lemma fits_errors : forall f st, fits f st -> Forall (fun e => length e = n_x f) (errorsR st) /\ length (errorsR st) = n f.
Proof.
  intros f st [X [L F]]. unfold errors. split; [|now rewrite map_length].
  rewrite Forall_map. eapply Forall_impl; [|exact F]. intros e E. simpl in E. rewrite sub_length; congruence.
Qed.
Definition at_ w (st : state R) := w ++ concat (errorsR st) ++ fst st.
Lemma forms_w : forall f w st, length w = n_w f -> map (val (at_ w st)) (w_forms f) = w.
Proof. intros f w st L. unfold w_forms, at_. rewrite axes, <- L. apply (part w []). Qed.
Lemma forms_st : forall f w st, length w = n_w f -> fits f st -> h_st _ _ (val (at_ w st)) (st_forms f) = st.
Proof.
  intros f w st L F. destruct (fits_errors f st F) as [E N]. destruct F as [X [M F]].
  assert (GX : map (val (at_ w st)) (x_forms f) = fst st).
  { unfold x_forms, at_. rewrite axes, app_assoc.
    pose proof (part (fst st) (w ++ concat (errorsR st)) []) as P. rewrite app_nil_r in P.
    rewrite app_length, (concat_length (n_x f)), L, N, X in P by auto. exact P. }
  unfold h_st, st_forms. simpl. rewrite GX, map_map. destruct st as [x xs]. f_equal. simpl in *.
  rewrite (map_ext _ (fun i => subR x (map (fun k => nth k (at_ w (x, xs)) 0) (seq (n_w f + i * n_x f) (n_x f))))).
  - pose proof (parts (n_x f) (errorsR (x, xs)) w x E) as P. rewrite L, N in P.
    rewrite <- (map_map (fun i => map (fun k => nth k (at_ w (x, xs)) 0) (seq (n_w f + i * n_x f) (n_x f))) (subR x)).
    unfold at_. simpl fst. rewrite P. unfold errors. simpl. rewrite map_map.
    rewrite <- (map_id xs) at 2. apply map_ext_in. intros xh I. apply sub_sub. rewrite Forall_forall in F. rewrite (F xh I). auto.
  - intro i. rewrite (h_sub _ _ rplus rtimes Rplus times (val (at_ w (x, xs)))), GX.
    + unfold e_forms. rewrite axes. reflexivity.
    + intros. apply val_plus.
    + intros. apply val_times.
Qed.

Lemma sum_ext : forall {I} (a b : I -> R) l, (forall i, In i l -> a i = b i) -> sum (map a l) = sum (map b l).
Proof. intros I a b l E. f_equal. apply map_ext_in. auto. Qed.
Lemma sum_line : forall {I} (a b : I -> R) c l, sum (map (fun i => a i + c * b i) l) = sum (map a l) + c * sum (map b l).
Proof. induction l; simpl; [lra|]. unfold sum in *. rewrite IHl. lra. Qed.
Lemma sum_le : forall {I} (a b : I -> R) l, (forall i, In i l -> a i <= b i) -> sum (map a l) <= sum (map b l).
Proof.
  induction l as [|i l IH]; intro L; simpl; [lra|]. pose proof (L i (or_introl eq_refl)).
  pose proof (IH (fun j J => L j (or_intror J))). unfold sum in *. lra.
Qed.
Lemma form_mixed : forall f s P v, formQ (mixed f s P) v =
  sum (map (fun t => Q2R (entry s t (Pi f) 0%Q) * formQ (nth t P []) v) (seq 0 (modes f))).
Proof.
  intros. unfold mixed. generalize (seq 0 (modes f)) as l. induction l; simpl; [destruct v; reflexivity|].
  rewrite form_plus, form_times, IHl. reflexivity.
Qed.
Lemma form_next : forall f x s P o w st, length w = n_w f -> fits f st ->
  formQ P (map (value (chances f) o (at_ w st)) (next_forms f x s)) = formQ P (etaR x (next f o s st w)).
Proof.
  intros f x s P o w st L F. f_equal. unfold next_forms, next.
  pose proof (value_plus) as VP. pose proof value_times as VT. pose proof value_chance as VC.
  rewrite (h_eta _ _ tplus ttimes Rplus times) by (intros; first [apply VP | apply VT]). f_equal.
  rewrite (h_step _ _ Zero tplus ttimes (tchance (chances f)) 0 Rplus times (thrown o)) by
    (intros; first [apply VP | apply VT | apply VC | reflexivity]).
  f_equal; [|rewrite map_map; apply forms_w; auto].
  rewrite <- (forms_st f w st L F) at 2. unfold h_st. simpl. f_equal; rewrite map_map; [reflexivity|].
  apply map_ext. intro. rewrite map_map. reflexivity.
Qed.

Definition total f s := sum (map Q2R (nth s (Pi f) [])).
Lemma forms_at : forall f x s, (s < modes f)%nat -> nth s (all_forms f x) [] = next_forms f x s.
Proof.
  intros f x s S. unfold all_forms. rewrite (nth_indep _ [] (next_forms f x 0)) by (rewrite map_length, seq_length; auto).
  rewrite map_nth, seq_nth; auto.
Qed.
Lemma form_17 : forall f x s here P d w st,
  forallb probable (chances f) = true -> (s < modes f)%nat -> length w = n_w f -> fits f st ->
  formQ (matrix_17 f x (all_forms f x) s here P d) (at_ w st) <= total f s * (norm2 w + formQ here (etaR x st)) -
    mean (chances f) (fun o => sum (map (fun t => Q2R (entry s t (Pi f) 0%Q) * V x P t (next f o s st w)) (seq 0 (modes f)))).
Proof.
  intros f x s here P d w st G S L F. unfold matrix_17, total, likely. rewrite forms_at by auto.
  rewrite form_plus, !form_times, form_plus, form_squares, form_lifted, forms_w, Q2R_sum, Q2R_opp1 by auto.
  pose proof (mean_spread d (chances f) (mixed f s P) (next_forms f x s) (at_ w st) G) as M.
  unfold eta_forms. rewrite (h_eta _ _ rplus rtimes Rplus times) by (intros; first [apply val_plus | apply val_times]).
  rewrite forms_st by auto.
  rewrite (mean_ext _ _ (fun o => sum (map (fun t => Q2R (entry s t (Pi f) 0%Q) * V x P t (next f o s st w)) (seq 0 (modes f)))))
    in M; [lra|].
  intro o. rewrite form_next, form_mixed by auto. reflexivity.
Qed.
Lemma form_18 : forall f g x here w st, length w = n_w f -> fits f st ->
  formQ (matrix_18 f g x here) (at_ w st) = Q2R g * Q2R g * formQ here (etaR x st) - norm2 (performance f st).
Proof.
  intros f g x here w st L F. unfold matrix_18.
  rewrite form_plus, !form_times, form_squares, form_lifted, qtimes_ok, Q2R_opp1. unfold eta_forms, z_forms, performance.
  rewrite (h_eta _ _ rplus rtimes Rplus times), (h_z _ _ [] rplus rtimes 0 Rplus times) by
    (intros; first [apply val_plus | apply val_times | destruct (at_ w st); reflexivity]).
  rewrite forms_st by auto. lra.
Qed.

Lemma zero_app : forall a b, zero (a ++ b) <-> zero a /\ zero b.
Proof. intros. apply Forall_app. Qed.
Lemma positive_at : forall f x X w st, positive (order f x) X = true -> length w = n_w f -> fits f st ->
  exists d, 0 <= formQ (X d) (at_ w st) /\ (~ zero (w ++ etaR x st) -> 0 < formQ (X d) (at_ w st)).
Proof.
  intros f x X w st P L F. destruct (fits_errors f st F) as [E N].
  assert (S : exists v u, at_ w st = v ++ u /\ length v = order f x /\ (zero v -> zero (w ++ etaR x st))).
  { unfold at_, order, eta. pose proof (concat_length (n_x f) _ E) as C. rewrite N in C. destruct F as [X' _].
    destruct x.
    - exists (w ++ concat (errorsR st) ++ fst st), []. rewrite app_nil_r, !app_length, C, L, X'. split; [reflexivity|]. split; [lia|].
      rewrite !zero_app. tauto.
    - exists (w ++ concat (errorsR st)), (fst st). rewrite app_assoc, app_length, C, L. split; [reflexivity|]. split; [lia|].
      intro Z; exact Z. }
  destruct S as [v [u [-> [K Z]]]]. apply positive_ok in P as [d [W P]]. exists d. destruct (zero_or v) as [O|O].
  - split; [|tauto]. rewrite (form_within (X d) (order f x)) by auto. unfold formQ. rewrite form_zero by auto. lra.
  - specialize (P v u K O). split; [lra | auto].
Qed.

Lemma row_in : forall (f : network) s, (s < modes f)%nat -> In (nth s (Pi f) []) (Pi f).
Proof. intros. apply nth_In. assumption. Qed.
Lemma proper_chances : forall f, proper f = true -> forallb probable (chances f) = true /\
  forallb (forallb probable) (Pi f) = true /\ forallb (fun row => negb (Qeq_bool (fold_right Qplus 0%Q row) 0)) (Pi f) = true.
Proof. intros f P. unfold proper in P. cbv zeta in P. rewrite !andb_true_iff in P. tauto. Qed.
Lemma total_pos : forall f s, proper f = true -> (s < modes f)%nat -> 0 < total f s.
Proof.
  intros f s P S. apply proper_chances in P as [_ [A B]]. rewrite forallb_forall in A, B.
  specialize (A _ (row_in f s S)). specialize (B _ (row_in f s S)). unfold total.
  assert (E : forall l, Q2R (fold_right Qplus 0%Q l) = sum (map Q2R l)).
  { induction l; simpl; [apply Q2R_0|]. rewrite Q2R_plus, IHl. reflexivity. }
  assert (0 <= sum (map Q2R (nth s (Pi f) []))).
  { revert A. generalize (nth s (Pi f) []). induction l as [|p l IH]; simpl; intro A; [lra|].
    apply andb_true_iff in A as [A1 A2]. apply probable_ok in A1. specialize (IH A2). unfold sum in *. lra. }
  assert (sum (map Q2R (nth s (Pi f) [])) <> 0); [|lra].
  rewrite <- E. intro Z. rewrite <- Q2R_0 in Z. apply eqR_Qeq, Qeq_bool_iff in Z. rewrite Z in B. discriminate.
Qed.
Lemma mean_le : forall ps g h, forallb probable ps = true -> (forall o, g o <= h o) -> mean ps g <= mean ps h.
Proof.
  induction ps as [|p ps IH]; intros g h P L; simpl in *; auto. apply andb_true_iff in P as [A P]. apply probable_ok in A.
  pose proof (IH (fun o => g (true :: o)) (fun o => h (true :: o)) P (fun o => L (_ :: o))).
  pose proof (IH (fun o => g (false :: o)) (fun o => h (false :: o)) P (fun o => L (_ :: o))). nra.
Qed.
Lemma entry_pos : forall f s t, proper f = true -> (s < modes f)%nat -> 0 <= Q2R (entry s t (Pi f) 0%Q).
Proof.
  intros f s t P S. apply proper_chances in P as [_ [A _]]. rewrite forallb_forall in A.
  specialize (A _ (row_in f s S)). rewrite forallb_forall in A. unfold entry.
  destruct (nth_in_or_default t (nth s (Pi f) []) 0%Q) as [I | ->]; [|rewrite Q2R_0; lra]. apply probable_ok; auto.
Qed.
Lemma expected_line : forall f s g h c,
  expected f s (fun o t => g o t + c * h o t) = expected f s g + c * expected f s h.
Proof.
  intros. unfold expected. rewrite <- mean_line. apply mean_ext. intro o. unfold switched.
  rewrite (sum_ext _ (fun t => Q2R (entry s t (Pi f) 0%Q) * g o t + c * (Q2R (entry s t (Pi f) 0%Q) * h o t))) by (intros; ring).
  rewrite sum_line. unfold Rdiv. ring.
Qed.
Lemma expected_ext : forall f s g h, (forall o t, g o t = h o t) -> expected f s g = expected f s h.
Proof. intros f s g h E. apply mean_ext. intro o. unfold switched. f_equal. apply sum_ext. intros. rewrite E. reflexivity. Qed.
Lemma expected_times : forall f s g c, expected f s (fun o t => c * g o t) = c * expected f s g.
Proof.
  intros. rewrite (expected_ext f s _ (fun o t => g o t + (c - 1) * g o t)) by (intros; ring). rewrite expected_line. ring.
Qed.
Lemma expected_le : forall f s g h, proper f = true -> (s < modes f)%nat ->
  (forall o t, (t < modes f)%nat -> g o t <= h o t) -> expected f s g <= expected f s h.
Proof.
  intros f s g h P S L. apply mean_le; [apply proper_chances; auto|]. intro o. unfold switched.
  apply Rmult_le_compat_r; [apply Rlt_le, Rinv_0_lt_compat, (total_pos f s P S)|].
  apply sum_le. intros t T. apply in_seq in T. apply Rmult_le_compat_l; [apply entry_pos; auto|]. apply L. lia.
Qed.

Lemma next_fits : forall f o s st w, fits f (next f o s st w).
Proof.
  intros. unfold fits, next, step, sized. simpl. rewrite !map_length, !seq_length. repeat split.
  rewrite Forall_map, Forall_forall. intros. now rewrite map_length, seq_length.
Qed.
Lemma all_ok : forall f ok s, every f ok = true -> (s < modes f)%nat -> ok s = true.
Proof. intros f ok s A S. unfold every in A. rewrite forallb_forall in A. apply A, in_seq. lia. Qed.
Lemma decide_17_ok : forall f x here P s st w, proper f = true -> decide_17 f x (all_forms f x) here P = true -> (s < modes f)%nat -> fits f st ->
  length w = n_w f -> let E := expected f s (fun o t => V x P t (next f o s st w)) in
  E <= norm2 w + V x here s st /\ (~ zero (w ++ etaR x st) -> E < norm2 w + V x here s st).
Proof.
  intros f x here P s st w R D S F L E. pose proof (all_ok f _ s D S) as A. simpl in A.
  destruct (positive_at f x _ w st A L F) as [d N].
  pose proof (form_17 f x s (nth s here []) P d w st (proj1 (proper_chances f R)) S L F) as M.
  assert (G : total f s * E = mean (chances f)
    (fun o => sum (map (fun t => Q2R (entry s t (Pi f) 0%Q) * V x P t (next f o s st w)) (seq 0 (modes f))))).
  { unfold E, expected. rewrite <- mean_times. apply mean_ext. intro o. unfold switched.
    pose proof (total_pos f s R S) as T. unfold total in *. field. lra. }
  rewrite <- G in M. change (formQ (nth s here []) (etaR x st)) with (V x here s st) in M.
  pose proof (total_pos f s R S). destruct N as [N1 N2]. split; [nra|]. intro Z. specialize (N2 Z). nra.
Qed.
Lemma decide_18_ok : forall f g x P s st, decide_18 f g x P = true -> (s < modes f)%nat -> fits f st ->
  let G := Q2R g * Q2R g * V x P s st in
  norm2 (performance f st) <= G /\ (~ zero (etaR x st) -> norm2 (performance f st) < G).
Proof.
  intros f g x P s st D S F G. pose proof (all_ok f _ s D S) as A. simpl in A.
  set (w := repeat 0 (n_w f)). assert (L : length w = n_w f) by apply repeat_length.
  assert (N0 : norm2 w = 0) by (unfold w; generalize (n_w f); induction n; [reflexivity|]; simpl; rewrite norm2_cons, IHn; lra).
  destruct (positive_at f x _ w st A L F) as [d N]. rewrite form_plus, form_squares, forms_w, form_18, N0 in N by auto.
  change (formQ (nth s P []) (etaR x st)) with (V x P s st) in N. fold G in N.
  destruct N as [N1 N2]. split; [lra|]. intro Z. assert (~ zero (w ++ etaR x st)) by (rewrite zero_app; tauto). specialize (N2 H). lra.
Qed.

Theorem inequalities : forall f g x P, decide f g x [P] = true -> theorem_1 f g x P.
Proof.
  intros f g x P D. unfold decide in D. simpl in D. rewrite !andb_true_iff in D. destruct D as [[[OK _] A] B].
  intros s st S F. split.
  - intros w L Z. apply (decide_17_ok f x P P s st w); auto.
  - apply (decide_18_ok f g x P s st); auto.
Qed.

Definition covers f g x k (P : list matrix) := forall s st w, (s < modes f)%nat -> fits f st ->
  peak f k s st w <= Q2R g * Q2R g * (energy f k s w + V x P s st).
Lemma covers_next : forall f g x k here P, proper f = true -> decide_17 f x (all_forms f x) here P = true -> covers f g x k P -> covers f g x (S k) here.
Proof.
  intros f g x k here P OK D C s st [w p] S F. cbn [peak energy fst snd].
  set (w' := sized R 0 (n_w f) w). assert (L : length w' = n_w f) by (unfold w', sized; now rewrite map_length, seq_length).
  eapply Rle_trans; [apply expected_le; auto; intros o t T; apply (C t _ (p o t) T); apply next_fits|]. simpl.
  pose proof (proj1 (decide_17_ok f x here P s st w' OK D S F L)) as E. simpl in E.
  rewrite expected_times.
  rewrite (expected_ext _ _ _ (fun o t => energy f k t (p o t) + 1 * V x P t (next f o s st w'))) by (intros; ring).
  rewrite expected_line. pose proof (Rle_0_sqr (Q2R g)) as G. unfold Rsqr in G. apply Rmult_le_compat_l; auto. lra.
Qed.
Lemma covers_all : forall f g x levels k, proper f = true -> chain f x (all_forms f x) levels = true -> covers f g x k (hd [] levels) ->
  forall j, exists P, covers f g x (k + j) P.
Proof.
  intros f g x levels. induction levels as [|P below IH]; intros k OK C B j; [discriminate|]. simpl in C, B.
  destruct below as [|P' below].
  - exists P. induction j as [|j IHj]; [now rewrite Nat.add_0_r|]. rewrite Nat.add_succ_r. apply (covers_next f g x _ P P); auto.
  - destruct (decide_17 f x (all_forms f x) P' P) eqn:D; [|discriminate]. destruct j as [|j]; [exists P; now rewrite Nat.add_0_r|].
    replace (k + S j)%nat with (S k + j)%nat by lia. apply IH; auto. apply (covers_next f g x k P' P); auto.
Qed.

Lemma times_0 : forall q, times q 0 = 0.
Proof. intro. unfold times. ring. Qed.
Lemma zero_sized : forall k, zero (sized R 0 k []).
Proof. intro. unfold zero, sized. rewrite Forall_map, Forall_forall. intros i _. destruct i; reflexivity. Qed.
Lemma zero_sub : forall a b, zero a -> zero b -> zero (subR a b).
Proof.
  unfold sub, add, scale. intros a b A. revert b. induction A as [|x a X A IH]; intros b B; [constructor|].
  destruct B as [|y b Y B]; simpl; constructor; [|apply IH; auto]. simpl. rewrite X, Y, times_0. ring.
Qed.
Lemma zero_origin : forall f x, zero (etaR x (origin f)).
Proof.
  intros f x. unfold eta, origin. apply zero_app. split; [destruct x; [apply zero_sized | constructor]|].
  unfold errors. simpl. generalize (seq 0 (n f)). induction l; simpl; [constructor|].
  apply zero_app. split; auto. apply zero_sub; apply zero_sized.
Qed.
Lemma origin_fits : forall f, fits f (origin f).
Proof.
  intro f. unfold fits, origin, sized. simpl. rewrite !map_length, !seq_length. repeat split.
  rewrite Forall_map, Forall_forall. intros. now rewrite map_length, seq_length.
Qed.

Theorem bound : forall f g x levels, decide f g x levels = true -> bounded f g.
Proof.
  intros f g x levels D. unfold decide in D. rewrite !andb_true_iff in D. destruct D as [[[OK G] A] C].
  apply Qle_bool_iff, Qle_Rle in G. rewrite Q2R_0 in G. split; auto. split; auto.
  assert (B : covers f g x 0 (hd [] levels)).
  { intros s st w S F. simpl. pose proof (proj1 (decide_18_ok f g x _ s st A S F)). lra. }
  intros k s w S. destruct (covers_all f g x levels 0 OK C B k) as [P E]. simpl in E.
  specialize (E s (origin f) w S (origin_fits f)).
  replace (V x P s (origin f)) with 0 in E by (symmetry; apply form_zero, zero_origin). lra.
Qed.
